"""Benchmarks of this project, and the programs that make its shipped models and reference pages.

They are not installed with the package. Each runs in a checkout of the repository:

    python -m benchmarks                time that the design saves, as ratios of one run (`make benchmark`)
    python -m benchmarks.table          one table with other libraries and lower limits
    python -m benchmarks.scale          time and candidates against the number of photos
    python -m benchmarks.needed         candidates that contain the exhaustive top-1, up to ten million photos
    python -m benchmarks.several        candidates of several grasps: one joint search, or one search per grasp
    python -m benchmarks.vectors        a large index without reranking
    python -m benchmarks.peers          kinds of index, compared with FAISS, hnswlib and usearch
    python -m benchmarks.again          rebuilds of an index
    python -m benchmarks.large          large photos, decoded at full and at reduced size
    python -m benchmarks.simulation     parts of a simulated grasp, compared with another checkout
    python -m benchmarks.versions       builds, queries and collection, compared with another checkout
    python -m benchmarks.growth         growth of collection with grasps and objects, and of a query with its grasps
    python -m benchmarks.training       images per second in training
    python -m benchmarks.gpu            speed-up by a GPU
    python -m benchmarks.shards         a sharded index, compared with one folder
    python -m benchmarks.queueing       cost of many shards, extrapolated
    python -m benchmarks.frontier       error against run time of the kernels (of a search: `retrieve frontier`)
    python -m benchmarks.hard_cases     stiff and extreme inputs of every numerical kernel, as a table
    python -m benchmarks.optics.photometric    fits the simulated gels' optics to real presses
    python -m benchmarks.models.shipped        trains, scores and retrains the checkpoint of the package
    python -m benchmarks.models.verdicts       accuracy of the verdicts "match", "none of these", ...
    python -m benchmarks.models.answers        verdict, ranking, P(object | present) and advice of answers
    python -m benchmarks.models.next_grasp     information of another grasp, compared with the page's estimate
    python -m benchmarks.models.scaling        accuracy against the number of training objects and grasps
    python -m benchmarks.models.recognition    checkpoints compared: one object among 10, 100 and 1,000
    python -m benchmarks.models.verify         stated and achieved error rates of verification
    python -m benchmarks.models.adapted        verification and the next grasp on VT60 after `retrieve adapt`
    python -m benchmarks.models.attended       occlusion maps of real touches
    python -m benchmarks.models.gel_tower      training of the package's touch tower for real gels
    python -m benchmarks.models.in_double      a command in float64
    python -m benchmarks.importers_memory      memory of the importers for many rows
    python -m benchmarks.service_load          the service under load
    python -m benchmarks.rehearsal             collect, check, train, index and query without hardware
    python -m benchmarks.structure             files, lines and imports of the packages; call paths through the code
    python -m benchmarks.reference             writes docs/reference.md, docs/commands.md and docs/datasets.md
    python -m benchmarks.page_picture DEMO     makes docs/images/page.jpg
    python -m benchmarks.notebooks             executes the notebooks and stores their outputs

No benchmark asserts a time. The arms of a ratio run in turn, so that a busy machine slows all of them.
"""
