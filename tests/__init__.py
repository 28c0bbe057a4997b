"""The tests, `test_<package>_<module>.py`, and what stands beside them.

Run by hand, each as `python -m tests.structure` is:

    benchmarks          what is timed, as ratios of one run (`make benchmark`)
    structure           how the code hangs together
    reference           writes docs/reference.md, docs/commands.md and docs/datasets.md
    notebooks           runs the notebooks again and stores what they show
    shipped             the checkpoint that comes with the package: made, scored, taught again
    verdicts            what its "match", "none of these", ... are worth
    answers             verdict, ranking and P(object | present) of answers from 30 objects, and what became of advice
    next_grasp          what another grasp tells, beside what the page says that it may be expected to tell
    scaling             accuracy by the number of objects and grasps to train on
    in_double           a command in float64
    importers_memory    how much memory importers take for many rows
    service_load        how the service holds under load
    faults              what breaks a cluster, and what comes of it
    emulated_rig        hundreds of grasps by the real drivers, among faults
    rehearsal           collect, check, train, index and query without hardware

What tests lean on:

    conftest                                    pictures and models that several files share
    synthetic, labelled                         drawn pictures
    made_up_evaluation, referenced              results and models of them
    miniatures, real_data_sets, data            public data sets in small, and where real ones lie
    fake_rig, replay_rig, views, meshes         rigs, depth pictures and solids made of arithmetic and of files
    fake_video, wsg50_bench, wsg50_packets      cameras and a gripper that are not there
    oracle, documents, pages                    what must come out; texts and pages taken apart
    serving, browser, s3, on_ray, waiting       other processes, and waits that end
"""
