"""Faults that are not of one mesh file: what is promised, and the test that proves it."""

PIPELINE, CLEAN, TRANSFER = "test_pipeline.py", "test_clean.py", "test_transfer.py"
STUDY, ENDS, FAULTS, BOUNDED = (
    "test_store.py",
    "test_interruptions.py",
    "test_faults.py",
    "test_bounded.py",
)

# input, outcome, file and name of the test
PROOFS = [
    (
        "NaN with `strict`",
        "excluded with the number of such vertices",
        FAULTS,
        "test_strict_excludes_what_would_be_repaired",
    ),
    ("holes with `close_holes`", "closed", FAULTS, "test_holes_are_closed_on_demand"),
    (
        "offset by 1e6, scale 1e-9 or 1e9",
        "the same study, in the input's units",
        FAULTS,
        "test_the_study_does_not_depend_on_place_and_unit",
    ),
    (
        "a new shape in other units, mirrored or upside down (`insert`)",
        "warned by a comparison with the shapes of the study; kept as it is",
        FAULTS,
        "test_what_looks_wrong_with_a_new_shape_beside_a_study_is_told",
    ),
    (
        "files that name different units or coordinate systems",
        "said, none is converted",
        FAULTS,
        "test_files_of_different_units_are_told",
    ),
    (
        "two shapes, one mirrored",
        "both are named",
        FAULTS,
        "test_of_two_mirror_images_none_is_the_right_one",
    ),
    (
        "one shape only",
        "one error with the reason",
        PIPELINE,
        "test_one_usable_shape_is_not_enough_and_the_reasons_are_named",
    ),
    (
        "two shapes",
        "maps and median (a tie, said); no modes, with the reason",
        PIPELINE,
        "test_two_shapes_have_no_modes_and_the_study_says_why",
    ),
    (
        "two identical shapes, among others or alone; all shapes identical",
        "maps and median; all distances zero, no NaN; modes only where shapes differ, "
        "else the reason; tests refuse",
        PIPELINE,
        "test_identical_shapes_give_finite_results_and_modes_only_beside_a_shape_that_differs",
    ),
    (
        "fewer than k eigenfunctions",
        "k reduced and said",
        FAULTS,
        "test_reduced_numbers_are_told",
    ),
    (
        "a registration that went wrong",
        "warned by its badness",
        FAULTS,
        "test_a_wrong_registration_is_told",
    ),
    (
        "labels of the wrong length or with unknown values",
        "error with file, expected, found",
        TRANSFER,
        "test_a_wrong_label_file_is_named_with_what_was_expected_and_found",
    ),
    (
        "landmarks outside the surface",
        "error with the name and the distance",
        TRANSFER,
        "test_landmarks_off_the_surface_are_brought_onto_it_and_the_distance_is_told",
    ),
    (
        "options out of range, k > K, too few pairs, a template that is none, "
        "a preset contradicted",
        "error with the legal range before a shape is read",
        PIPELINE,
        "test_an_option_out_of_range_is_refused_with_the_legal_range_before_a_shape_is_read",
    ),
    ("more pairs than the clique has", "the clique, said", FAULTS, "test_reduced_numbers_are_told"),
    (
        "a study with lost, truncated or zero-byte files",
        "these are computed again and no others",
        PIPELINE,
        "test_lost_and_broken_files_are_computed_again_and_no_others",
    ),
    ("a study with foreign files", "computed again", STUDY, "test_a_foreign_file_is_not_done"),
    ("a study from another version", "computed again", ENDS, "test_another_version_computes_again"),
    (
        "read-only folder, full disk",
        "one clear error, finished files stay whole",
        ENDS,
        "test_a_disk_that_takes_no_more_ends_in_one_error_and_leaves_whole_files",
    ),
    (
        "kill -9 at any stage",
        "the next run goes on there and ends with the same study; files of finished tasks stay",
        ENDS,
        "test_a_run_killed_in_every_stage_ends_with_the_same_study",
    ),
    (
        "kill -9 of a run with workers",
        "resumes; its workers are gone within seconds and write nothing",
        ENDS,
        "test_workers_are_gone_within_seconds_of_the_end_of_a_run_and_the_study_is_resumable",
    ),
    (
        "Ctrl-C",
        "stops within seconds, workers gone, resumable",
        ENDS,
        "test_workers_are_gone_within_seconds_of_the_end_of_a_run_and_the_study_is_resumable",
    ),
    (
        "two runs on one folder",
        "the second says that the first is working, with its process",
        PIPELINE,
        "test_a_second_run_in_the_same_folder_is_refused",
    ),
    (
        "a study whose names lead out of its folder",
        "left out and said, nothing outside is read or written",
        ENDS,
        "test_names_that_lead_out_of_a_study_are_left_out",
    ),
    (
        "archives (NPZ, VTP, GIFTI) that unpack to too much",
        "excluded before memory fills",
        BOUNDED,
        "test_what_unpacks_to_too_much_is_refused",
    ),
]
