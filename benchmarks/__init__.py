"""Benchmarks of this project, and the programs that make its shipped models and reference pages.

They are not installed with the package. Each runs in a checkout of the repository:

    python -m benchmarks                time that the design saves, as ratios of one run (`make benchmark`)
    python -m benchmarks.table          one table with other libraries and lower limits. Separate benchmarks:
                                        scale, needed, several, vectors, peers, again, large, simulation, growth,
                                        training, gpu, shards, queueing
    python -m benchmarks.frontier       error against run time of the kernels (of a search: `retrieve frontier`)
    python -m benchmarks.hard_cases     stiff and extreme inputs of every numerical kernel, as a table
    python -m benchmarks.optics.photometric    fits the simulated gels' optics to real presses
    python -m benchmarks.models.shipped        trains, scores and retrains the checkpoint of the package
    python -m benchmarks.models.verdicts       accuracy of the verdicts "match", "none of these", ...
    python -m benchmarks.models.answers        verdict, ranking, P(object | present) and advice of answers
    python -m benchmarks.models.next_grasp     information of another grasp, compared with the page's estimate
    python -m benchmarks.models.scaling        accuracy against the number of training objects and grasps
    python -m benchmarks.models.in_double      a command in float64
    python -m benchmarks.importers_memory      memory of the importers for many rows
    python -m benchmarks.service_load          the service under load
    python -m benchmarks.faults                faults of a sharded index, and their consequences
    python -m benchmarks.rehearsal             collect, check, train, index and query without hardware
    python -m benchmarks.structure             files, lines and imports of the packages; call paths through the code
    python -m benchmarks.reference             writes docs/reference.md, docs/commands.md and docs/datasets.md
    python -m benchmarks.page_picture DEMO     makes docs/images/page.jpg
    python -m benchmarks.notebooks             executes the notebooks and stores their outputs

No benchmark asserts a time. The arms of a ratio run in turn, so that a busy machine slows all of them.
"""
