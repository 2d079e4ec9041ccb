"""Faults that are not of one mesh file: what is promised, and the test that proves it."""

DOUBTFUL = "test_doubtful.py"
PIPELINE, CLEAN, TRANSFER = "test_pipeline.py", "test_clean.py", "test_transfer.py"
STUDY, ENDS, FAULTS, BOUNDED = (
    "test_store.py",
    "test_interruptions.py",
    "test_faults.py",
    "test_bounded.py",
)
RAW = "test_raw.py"
STRUCTURES = "test_poses.py"

STATISTICS, SUBJECTS = "test_statistics.py", "test_subjects.py"

SEAL = "test_seal.py"

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
        "a named pipe, a socket, a device, a link that leads nowhere or to itself, a file of over "
        "2 GiB, in the folder",
        "excluded with the reason, at once; the others have the results that they have alone",
        RAW,
        "test_a_run_over_them_has_the_results_of_the_good_ones_alone",
    ),
    (
        "a file that may not be read, or fails while it is read",
        "excluded with the reason",
        RAW,
        "test_a_file_that_may_not_be_read_is_named",
    ),
    (
        "a folder that cannot be searched, a link to a folder, a folder named like a mesh",
        "told in the remarks",
        RAW,
        "test_a_folder_that_cannot_be_searched_is_told",
    ),
    (
        "names of 250 letters, of 80 letters of five codes each, not of UTF-8, or that differ "
        "in case only",
        "works; names of shapes are unique and have at most 100 letters, of longer ones a hash is "
        "the end, and it is told",
        RAW,
        "test_names_of_shapes_are_unique_and_short_enough_for_the_files_of_a_study",
    ),
    (
        "line ends, colours of a terminal or marks of direction in the name of a file",
        "written as escapes wherever the name is shown",
        RAW,
        "test_a_name_writes_no_line_of_its_own",
    ),
    (
        "a single triangle, a tetrahedron, among good shapes",
        "the run goes on with the others",
        FAULTS,
        "test_a_triangle_and_a_tetrahedron_end_no_run",
    ),
    (
        "surfaces that are none: soup whose corners do not meet, slivers, heaps of triangles, many "
        "or tiny pieces, any scale and offset",
        "cleaned and remeshed, or excluded by name; no other exception in 5 s each",
        "test_fuzz.py",
        "test_damaged_files_are_read_or_refused_by_name_in_bounded_time_and_memory",
    ),
    (
        "numbers of the command line that are none or too large (10^22, NaN, 1e3, ², 5,000 digits)",
        "one sentence, exit code 2",
        "test_cli.py",
        "test_numbers_that_are_none_are_refused_in_a_sentence",
    ),
    (
        "100 GiB in a .gz of 100 MB",
        "refused at 64 MiB of it, as is a block of VTP or GIFTI",
        BOUNDED,
        "test_what_unpacks_to_too_much_is_refused_before_it_fills_the_memory",
    ),
    (
        "an archive (NPZ) that lies about its sizes",
        "read no further than it says",
        BOUNDED,
        "test_an_archive_that_lies_about_its_sizes_is_read_no_further_than_it_says",
    ),
    (
        "a table in UTF-16, Latin-1, with NUL bytes, or a workbook",
        "error that says what it seems to be and how to save it",
        "test_subjects.py",
        "test_a_table_in_another_encoding_is_told_with_what_it_seems_to_be",
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
        "fewer eigenfunctions than most others",
        "excluded with both numbers; k stays; it falls only where at least half lack them, "
        "said first",
        DOUBTFUL,
        "test_a_shape_with_too_few_eigenfunctions_is_excluded_and_takes_no_k_from_the_others",
    ),
    (
        "doubtful shapes among good ones",
        "these have the same results, to the bit, as without; those are registered, "
        "in no modes or statistics, never the template",
        DOUBTFUL,
        "test_the_results_of_the_others_are_the_same_to_the_bit_as_without",
    ),
    (
        "doubtful shapes with `keep_doubtful`",
        "they enter modes and statistics",
        DOUBTFUL,
        "test_they_enter_modes_and_statistics_on_demand",
    ),
    (
        'doubtful shapes with `doubtful="stop"`',
        "one error that names them by kind, before the long stages",
        DOUBTFUL,
        "test_a_run_can_stop_at_them_before_its_long_stages",
    ),
    (
        "a doubtful shape that `template` names",
        "it is the template, and said",
        DOUBTFUL,
        "test_a_doubtful_shape_is_the_template_where_it_is_named",
    ),
    (
        "fewer than two shapes beyond doubt",
        "all are treated alike, and said",
        DOUBTFUL,
        "test_where_fewer_than_two_are_beyond_doubt_all_are_treated_alike",
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
    (
        "an option that the preset fixes, given otherwise, for an analysis or pairs",
        "refused by name, with the preset's value",
        "test_preset.py",
        "test_an_option_that_the_preset_fixes_is_refused_by_name",
    ),
    (
        "an option that the preset of a study fixes, given otherwise for a transfer to it",
        "refused by name; with another preset, it is taken",
        "test_preset.py",
        "test_a_transfer_refuses_by_name_what_its_preset_fixes",
    ),
    (
        "options of pairs for a transfer from a shape that is registered",
        "refused by name, with the shape",
        "test_preset.py",
        "test_options_are_refused_where_nothing_is_matched",
    ),
    (
        "labels of an external mesh for a study of pairs, which has no low resolution",
        "refused, with what to give",
        "test_preset.py",
        "test_an_external_mesh_needs_more_than_a_study_of_pairs",
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
        "a disk that is full in whatever stage",
        "one clear error; with room again, the next run goes on there and ends with the same study",
        ENDS,
        "test_a_disk_that_is_full_in_every_stage_keeps_what_is_finished",
    ),
    (
        "a mesh that changes or vanishes while the run reads it",
        "one error that names it; with the file back, the next run ends with the same study",
        ENDS,
        "test_files_that_vanish_or_change_while_they_are_read_end_the_run_which_then_goes_on",
    ),
    (
        "a folder of meshes that vanishes, as one that is no longer mounted",
        "one error that names a file, until all are read; no later stage needs them; finished "
        "files are kept",
        ENDS,
        "test_a_folder_that_vanishes_ends_a_run_until_it_is_read_and_is_not_missed_in_later_stages",
    ),
    (
        "an error that nobody foresaw, or no memory, in the task of one shape",
        "the shape is excluded with one line, exit code 1; the traceback is in `.log` of the study",
        ENDS,
        "test_an_error_in_the_task_of_one_shape_costs_that_shape_and_is_told",
    ),
    (
        "such an error where all shapes are needed",
        "one line with the file of the traceback, exit code 2; finished files stay and are used",
        ENDS,
        "test_an_error_in_a_stage_of_all_shapes_ends_the_run_in_one_line_and_keeps_what_is_finished",
    ),
    (
        "a worker that crashes or is killed, for want of memory for example",
        "its task is done again, alone; a shape of which two died is excluded, no other is touched",
        ENDS,
        "test_a_crash_costs_the_shape_whose_processes_die_twice_and_nobody_else",
    ),
    (
        "a crash in a run of one process, which it ends",
        "the third run does that task in a process of its own, and goes on",
        ENDS,
        "test_a_task_of_which_two_processes_died_comes_in_a_process_of_its_own",
    ),
    (
        "kill -9 at any stage",
        "the next run goes on there and ends with the same study; files of finished tasks stay",
        ENDS,
        "test_a_run_killed_in_every_stage_ends_with_the_same_study",
    ),
    (
        "Ctrl-C, SIGTERM, kill -9, a closed terminal; while workers start, or in native code",
        "workers are gone within seconds and write nothing; no semaphore is left",
        ENDS,
        "test_workers_are_gone_within_seconds_of_the_end_of_a_run_and_leave_nothing",
    ),
    (
        "Ctrl-C that comes where Python drops it, as in a destructor",
        "the run ends after the task that it is at",
        ENDS,
        "test_an_interruption_that_gets_lost_ends_the_run_after_the_task",
    ),
    (
        "kill -9 of a run with `--cluster local:N` while its workers start",
        "they are gone within a second",
        "test_cluster.py",
        "test_workers_of_dask_that_are_just_starting_are_gone_soon_after_a_run_that_is_killed",
    ),
    (
        "kill -9 of a run and all of its workers at once",
        "resumes; the next run removes the semaphores and memory maps that they left",
        ENDS,
        "test_a_run_killed_with_its_workers_goes_on_and_the_next_one_removes_what_they_left",
    ),
    (
        "kill -9 of a run that keeps no study",
        "the next one removes its temporary folder",
        ENDS,
        "test_temporary_studies_of_killed_runs_are_removed_and_those_of_others_stay",
    ),
    (
        "a power cut",
        "a file is on the disk before it has its name; the next run goes on",
        ENDS,
        "test_a_file_is_on_the_disk_before_it_has_its_name",
    ),
    (
        "two runs on one folder",
        "the second says that the first is working, with its process",
        PIPELINE,
        "test_a_second_run_in_the_same_folder_is_refused",
    ),
    (
        "a study whose names lead out of its folder",
        "refused, nothing outside is read or written",
        ENDS,
        "test_names_that_lead_out_of_a_study_are_refused",
    ),
    (
        "a column of the table with one `?`, or with decimal commas",
        "a warning with its cells when it is read; no test takes it",
        SUBJECTS,
        "test_a_column_that_is_mostly_numbers_is_named_with_its_cells",
    ),
    (
        "`NA`, `n/a`, `-` or nothing in a column of text",
        "missing, and no group; the shapes are left out of the test and named",
        STATISTICS,
        "test_a_missing_text_is_no_group",
    ),
    (
        "shapes without a value of a number",
        "left out of the test and named",
        SUBJECTS,
        "test_shapes_without_a_value_are_left_out_of_the_test_and_named",
    ),
    (
        "a covariate of dates, names of shapes, or more columns than shapes",
        "error with what was found and what to give",
        STATISTICS,
        "test_a_covariate_of_no_use_is_refused_with_what_to_do",
    ),
    (
        "a covariate that numbers the shapes: whole numbers that all differ and have no gaps, or "
        "the name of identifiers",
        "used as it is, with a warning",
        STATISTICS,
        "test_a_covariate_that_numbers_the_shapes_is_told",
    ),
    (
        "a row of labels or landmarks with too few cells, too many, or a word for a number",
        "error with file and line",
        TRANSFER,
        "test_a_row_of_landmarks_that_is_none_is_named_with_its_line",
    ),
    (
        "a packed variable of a study that unpacks to more or less than it says",
        "refused with the file, before memory is asked for",
        SEAL,
        "test_a_variable_that_says_it_unpacks_to_more_than_deflate_can_is_refused",
    ),
    (
        "covariates that are constant or a linear combination of others",
        "the same test as without them; warned, with the names",
        STATISTICS,
        "test_what_becomes_of_the_covariates_is_told",
    ),
    (
        "a variable that is constant up to rounding, infinite, of 1e-300, of dates",
        "error with what was found and what to give",
        STATISTICS,
        "test_a_variable_of_no_use_is_refused_with_what_to_do",
    ),
    (
        "groups of fewer than 3 shapes, fewer than 4 shapes",
        "error with the sizes",
        STATISTICS,
        "test_small_groups_are_refused_or_warned_of_and_the_smallest_p_is_told",
    ),
    (
        "so few shapes that no p value can be under 0.05",
        "exact p values, warned with the smallest that can be",
        STATISTICS,
        "test_a_test_that_can_find_nothing_says_so",
    ),
    (
        "groups that scatter differently",
        'warned with the scatter of each; `variances="unequal"` holds the level',
        STATISTICS,
        "test_groups_of_unequal_scatter_are_told_and_signs_hold_the_level",
    ),
    (
        "-1, 0 or 10^22 permutations",
        "error with the legal range",
        STATISTICS,
        "test_a_number_of_permutations_that_makes_no_test_is_refused",
    ),
    (
        "covariates, and no group or variable to test",
        "one sentence, exit code 2",
        "test_cli.py",
        "test_an_error_is_one_line_and_the_exit_code_2",
    ),
    (
        "statistics of equal shapes, or with displacements that are not finite",
        "error with the names",
        STATISTICS,
        "test_statistics_of_shapes_that_are_equal_or_not_finite_say_so",
    ),
    (
        "a field of the wrong length, missing for one shape, infinite, NaN everywhere, or for "
        "what is no shape",
        "error with the shape and what is needed; missing ones are left out on demand",
        "test_fields.py",
        "test_a_field_that_does_not_fit_is_refused_by_shape",
    ),
    (
        "a field that is constant in one shape, in all, or NaN at some vertices",
        "warned, with the shape; refused; these vertices are not tested, warned",
        "test_fields.py",
        "test_vertices_and_shapes_without_a_field_are_left_out_and_told",
    ),
    (
        "growth with a subject of one visit, or none with two, visits without a subject, time as "
        "text",
        "warned by name, it is not in the test; error; left out by name; error",
        "test_growth.py",
        "test_what_is_no_repeated_measure_is_refused_or_told",
    ),
    (
        "one person with several shapes in the table",
        "warned, with the shapes",
        SUBJECTS,
        "test_a_person_of_several_shapes_is_named",
    ),
    (
        "a table of an earlier run, and other meshes now",
        "kept, and said which rows and names it is about",
        SUBJECTS,
        "test_a_table_of_other_meshes_is_named",
    ),
    (
        "guiding landmarks of some shapes only",
        "the others are registered without, and named",
        "test_landmarks.py",
        "test_a_study_keeps_its_landmarks_and_says_who_has_none",
    ),
    (
        "a guiding field of some shapes only",
        "the others are registered without, and named",
        "test_features.py",
        "test_a_study_reads_fields_beside_its_files_and_says_who_has_none",
    ),
    (
        "a guiding field that no file has",
        "error that says where it would be",
        "test_features.py",
        "test_a_field_that_no_file_has_is_an_error",
    ),
    (
        "a guiding field of another length, infinite, NaN everywhere or without a file",
        "error that names it",
        "test_features.py",
        "test_a_field_that_does_not_fit_is_refused",
    ),
    (
        "guiding landmarks of another mesh or unit",
        "the shape is excluded with the landmark and its distance; the others go on",
        "test_landmarks.py",
        "test_a_shape_whose_landmarks_lie_elsewhere_is_excluded_with_the_reason",
    ),
    (
        "two guiding landmarks of one name, two files for one shape, a folder without any",
        "error that names them",
        "test_landmarks.py",
        "test_names_that_are_there_twice_are_refused_and_points_of_curves_left_out",
    ),
    (
        "a landmark at NaN or 1e300",
        "error with its name",
        TRANSFER,
        "test_a_landmark_at_no_place_is_named",
    ),
    (
        "a study with a flipped bit, anywhere in any file",
        "an error that names the file when it is opened, or the variable when it is read; the same "
        "run makes that file anew, bit for bit, and no other",
        SEAL,
        "test_a_run_makes_damaged_files_anew_and_no_others_and_the_same_bytes",
    ),
    (
        "bytes lost, zeroed or cut off",
        "the same",
        SEAL,
        "test_bytes_lost_or_zeroed_anywhere_are_seen",
    ),
    (
        "`.costs.json` of another form",
        "told; times of earlier runs are not counted",
        SEAL,
        "test_costs_of_another_form_are_told_and_counted_as_none",
    ),
    (
        "a study of a stranger: external storage, external and soft links, virtual datasets, "
        "filters, groups, texts that repeat themselves",
        "refused with the file and what it has, before a value is read",
        SEAL,
        "test_what_leads_out_of_a_file_or_unpacks_is_refused_before_it_is_read",
    ),
    (
        "a symbolic link or a pipe in a study",
        "refused; the folder of the study itself may be a link",
        SEAL,
        "test_symbolic_links_within_a_study_are_not_followed",
    ),
    (
        "a symbolic link in the place of a report, a page or results that a command writes into a "
        "study",
        "refused before anything is computed; what it leads to is not touched",
        SEAL,
        "test_a_link_in_a_study_is_not_written_through",
    ),
    (
        "a pipe in such a place",
        "refused before anything is computed",
        SEAL,
        "test_a_pipe_in_a_study_is_not_written_to",
    ),
    (
        "a file without a variable, an attribute or a name, with an index out of range, of another "
        "kind or size",
        "refused with the file and what it should hold",
        SEAL,
        "test_a_file_that_does_not_hold_what_it_should_is_named_with_what",
    ),
    (
        "files damaged, missing, left over, foreign or of an earlier run",
        "`s4a verify` names them in one line each; exit code 1 where the study does not hold",
        SEAL,
        "test_verify_says_in_one_line_what_holds_and_its_exit_code_whether",
    ),
    (
        "a subject without one of several structures, or with one that is doubtful",
        "warned by name; in the modes of its other structures, not in what is said of all together",
        STRUCTURES,
        "test_warnings_name_the_subject_that_lacks_a_structure",
    ),
    (
        "two shapes of one structure of a subject, a shape without structure or subject, or a "
        "column of structures without subjects",
        "error that names them",
        "test_several.py",
        "test_tables_that_do_not_say_whose_a_shape_is_are_refused",
    ),
    (
        "one structure only, one that a single subject has, landmarks in no folder of a structure",
        "error with the reason, before anything is computed",
        "test_several.py",
        "test_structures_that_do_not_go_together_are_refused",
    ),
    (
        "a structure of one subject far away, as if in another frame",
        "warned by subject and structure, with how far",
        STRUCTURES,
        "test_structures_that_do_not_fit_together_are_told_of",
    ),
    (
        "a mesh without its structure, an unknown structure, or reflect= of none of the subjects, "
        "for a study of several structures",
        "error that says how new subjects are given",
        "test_several.py",
        "test_what_cannot_be_inserted_is_refused",
    ),
    (
        "new subjects of other structures, unit or templates than the study that is compared",
        "error that says what was needed and found",
        STRUCTURES,
        "test_new_subjects_of_other_structures_or_templates_are_refused",
    ),
    (
        "structures of one subject of which some are to be mirrored and others are not",
        "error with the subject and what the column has for each, as their poses would be lost",
        "test_several.py",
        "test_structures_of_one_subject_are_mirrored_together_or_not_at_all",
    ),
    (
        'a subject with structures of both hands, and `reflect="auto"`',
        "left as it is and named, with the hand of each structure",
        "test_several.py",
        "test_structures_say_together_of_which_hand_a_subject_is",
    ),
    (
        "a folder of landmarks that is named as no structure, or none for some structure",
        "error with the name; the structure is registered without, and named",
        "test_several.py",
        "test_landmarks_of_folders_and_of_a_table_do_what_those_in_memory_do",
    ),
    (
        "a structure of one subject mirrored in its file",
        "warned by subject",
        STRUCTURES,
        "test_structures_that_do_not_fit_together_are_told_of",
    ),
    (
        "structures whose files were centred each for itself, so that poses are lost",
        "warned by structure",
        STRUCTURES,
        "test_structures_that_do_not_fit_together_are_told_of",
    ),
    (
        "structures in different units",
        "error where the files name them; warned where sizes differ by more than 300",
        STRUCTURES,
        "test_structures_that_do_not_fit_together_are_told_of",
    ),
    (
        "archives (NPZ, VTP, GIFTI) that unpack to too much",
        "excluded before memory fills",
        BOUNDED,
        "test_what_unpacks_to_too_much_is_refused",
    ),
]
