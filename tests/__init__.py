"""The tests, `<package>/<folder>/test_<module>.py`, and their helpers.

    indexes, robot, retrieval                   tests of the packages, in the same folders
    benchmarks, models, project                 of these folders; of documentation, imports and packaging
    integrations                                tests of `integrations/`, with stubs of the other programs
    conftest                                    pictures and models that several files use
    synthetic                                   synthetic pictures
    synthetic_evaluation, reference_model       synthetic results, and a model with reference calibration
    as_they_come                                inputs as cameras, shops, spreadsheets and systems leave them
    miniatures, real_data_sets, data            small public data sets, and the folder of real ones
    emulators                                   a WSG-50 and a Sawyer as programs, based on the facts of the drivers
    emulated_rig                                the real drivers with emulated devices and injected faults
    fake_rig, replay_rig, views, meshes         rigs, depth pictures and solids from formulas and from files
    fake_video                                  fake cameras
    oracle, documents, pages                    expected search results; parsers of documents and pages
    verification                                a calibration of verifications with given bounds
    hard_case                                   one stiff or extreme input
    hostile_pictures                            small picture files of many pixels
    plugins                                     entry points of a package that is not installed
    serving, browser, ray_processes, waiting    other processes, and waits with a limit

The stiff and extreme inputs of a kernel are next to its tests, in `hard_*.py`.
"""
