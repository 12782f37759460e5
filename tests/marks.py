"""Which tests `make test` leaves out, and why."""

from __future__ import annotations

#: Beginnings of the names of tests, by the mark that they get; pyproject.toml says what the marks mean.
MARKS = {
    "process": (
        "cli/test_cli_fleet.py::test_a_f", "cli/test_cli_fleet.py::test_ctrl_c",
        "cli/test_cli_imitate.py::test_ctrl_c", "cli/test_cli_torchrun.py::test_two_processes",
        "cli/test_cli_verbs.py::test_a_closed_pipe", "cli/test_cli_verbs.py::test_info_loads",
        "cli/test_cli_verbs.py::test_version_and_help", "formats/test_fuzz_runner.py::test_a_run",
        "jobs/test_disk.py::test_a_full_disk", "jobs/test_fleet.py", "jobs/test_fleet_ray.py",
        "jobs/test_resume_imitation.py", "jobs/test_track_policy.py::test_a_program",
        "integrations/test_blender.py", "learn/test_lock.py::test_a_training_that_was_killed",
        "learn/test_parallel.py", "learn/test_train.py::test_kills", "live/test_record.py::test_kill_9",
        "test_face.py::test_importing",
    ),
    "browser": (
        "live/test_page.py::test_push_fall", "report/test_report_browser.py",
    ),
    "learned": (
        "cli/test_cli_play_compliant.py::test_a_scene_with_lookahead",
        "jobs/test_complete.py::test_keyframes_become", "jobs/test_complete.py::test_the_command",
        "jobs/test_complete.py::test_too_little", "jobs/test_complete.py::test_weights",
        "jobs/test_push.py::test_more_compliance", "jobs/test_shipped_tracker.py",
        "jobs/test_track_chain.py::test_a_clip_that", "jobs/test_track_retake.py::test_files",
        "jobs/test_track_retake.py::test_only", "jobs/test_track_retake.py::test_the_command",
        "jobs/test_track_supports.py::test_a_motion_that_sits",
        "live/test_loop.py::test_a_character_follows", "live/test_loop.py::test_who_goes_away",
        "live/test_points.py::test_a_policy_of_keypoints", "papers/compliant/test_compliant_play.py",
        "synthesis/test_sparse.py::test_poses_become", "synthesis/test_sparse.py::test_what_is_known",
    ),
    "training": (
        "cli/test_cli_perpetual.py::test_all_stages", "cli/test_cli_practice.py",
        "cli/test_cli_track.py::test_a_motion_that_is_lost_is_learned",
        "jobs/test_demonstrations.py", "jobs/test_perpetual_", "learn/test_ppo.py::test_ppo_solves",
        "papers/skeleton2humanoid/test_skeleton_to_humanoid.py::test_it_learns",
        "papers/perpetual/test_perpetual_", "papers/perpetual/test_trajopt.py::test_a_real_run",
        "papers/perpetual/test_trajopt.py::test_help_ends",
        "recipes/test_perpetual_shapes.py::test_a_training",
        "synthesis/test_generator.py::test_training_lowers",
    ),
    "data": (
        "formats/test_motion_index.py", "jobs/test_perpetual_data.py::test_real_clips",
        "score/test_inbetween_protocol.py::test_bandai",
        "score/test_inbetween_protocol.py::test_the_lafan1",
    ),
    "docs": (
        "test_docs.py::test_python_snippets_run", "test_docs_commands.py", "test_notebooks.py",
    ),
    "benchmarks": ("benchmarks/",),
}  # fmt: skip
