"""The tests, `<package>/<room>/test_<module>.py`, and their support.

    indexes, robot, retrieval                   the packages' tests, in folders as theirs
    benchmarks, project                         those of `benchmarks/`; of documentation, imports, packaging
    conftest                                    pictures and models that several files share
    synthetic, labelled                         drawn pictures
    made_up_evaluation, referenced              results and models of them
    miniatures, real_data_sets, data            public data sets in small, and where real ones lie
    emulators                                   a WSG-50 and a Sawyer as programs, written from the facts of the drivers
    emulated_rig                                hundreds of grasps by the real drivers, among faults
    fake_rig, replay_rig, views, meshes         rigs, depth pictures and solids made of arithmetic and of files
    fake_video, wsg50_bench, wsg50_packets      cameras and a gripper that are not there
    oracle, documents, pages                    what must come out; texts and pages taken apart
    hard_case                                   one stiff or extreme input
    hostile_pictures, decoding                  pictures that are slow to decode; processes that hang
    plugins                                     entry points of a package that is not installed
    serving, browser, s3, on_ray, waiting       other processes, and waits that end

The stiff and extreme inputs of a kernel stand next to its tests, in `hard_*.py`.
"""
