"""Which tests need the machine to themselves, which begin first, and how each of several processes
keeps to itself.

`python3 start.py test` has two processes share the files of tests; those of ALONE, and tests with
the mark `alone` of their own, run afterwards, one by one.
"""

import os
import tempfile
from pathlib import Path

TESTS = Path(__file__).parent
# Files and rooms, and why; commands that a page asks to be typed are marked in
# tests/stories/pages.py. Processor time is measured too: beside a busy neighbour a core is slower.
ALONE = {
    "tools/classroom/test_splats_page.py": "a browser",
    "tools/cli/test_bridge.py": "a board in real time, and Ctrl-C",
    "tools/classroom/test_sticks.py": "a browser",
    "tools/cli/test_class.py": "a class in real time",
    "tools/classroom/test_server.py": "sockets and floods in real time",
    "stories/test_classroom.py": "a browser beside a flight in real time",
    "tools/cli/test_calibrate.py": "a board in real time",
    "tools/cli/test_fly_aircraft.py": "a board and a camera in real time",
    "tools/classroom/test_share.py": "a browser",
    "firmware/test_ros_latency.py": "from image to pulses in real time",
    "tools/bridge/test_bag.py": "ROS plays a flight in real time",
    "flight/test_loop.py": "a loop on the wall's clock",
    "tools/bridge/test_recording.py": "recordings that are killed as they go",
    "tools/classroom/test_pages.py": "a browser and a page's server",
    "tools/grading/test_attacks.py": "the sandbox's time limits, and processes that may not remain",
    "tools/grading/test_collect.py": "processor time",
    "tools/grading/test_figures.py": "the sandbox's time limits, and processes that may not remain",
    "tools/grading/test_grade.py": "graders that are killed as they go, and what may not remain",
    "tools/grading/test_public_checks.py": "further questions to a wrong function in a second",
    "tools/grading/test_quiz.py": "the wall's clock",
    "tools/grading/test_sandbox.py": "the sandbox's time limits, and processes that may not remain",
    "tools/grading/test_submissions.py": "processor time",
    "manual/test_lectures.py": "processor time",
    "manual/test_site.py": "processor time and a browser",
    "stories/test_host_killed.py": "a flight in real time",
    "stories/test_live_demo.py": "a browser beside a flight in real time",
    "tools/bridge/test_bus.py": "ROS",
    "trainer_port/test_links.py": "a board behind a pseudo-terminal in real time",
    "tools/bridge/test_ros.py": "ROS",
    "tools/reports/test_gap_page.py": "a browser",
    "tools/bridge/test_simulated_board.py": "a board behind a pseudo-terminal in real time",
}
# Files that take minutes, longest first: begun late, they would keep one process busy while the
# other waits.
LONGEST = (
    "sysid/test_identify.py",
    "tools/demo/test_recorded.py",
    "stories/test_blind_naming.py",
    "stories/test_page_commands.py",
    "gap/test_name.py",
    "tools/reports/test_gap_report.py",
    "labs/test_notebooks.py",
    "labs/test_grades.py",
    "aircraft/test_integrate.py",
    "stories/test_manual_photos.py",
    "tools/grading/test_report.py",
    "core/test_fuzz.py",
)


def place_in_line(path: Path) -> int:
    """The order in which several processes take files of tests: the longest first, the others as
    they come.
    """
    name = path.relative_to(TESTS).as_posix() if path.is_relative_to(TESTS) else ""
    return LONGEST.index(name) if name in LONGEST else len(LONGEST)


def needs_the_machine(path: Path) -> bool:
    """Whether a file of tests is named above, itself or by its room."""
    parts = path.relative_to(TESTS).parts if path.is_relative_to(TESTS) else ()
    return any("/".join(parts[:count]) in ALONE for count in range(1, len(parts) + 1))


def keep_apart() -> tempfile.TemporaryDirectory[str] | None:
    """Give a process of pytest-xdist one thread, and numba a cache of its own; leave any other
    process as it is.

    Numba's cache has no lock: two processes that compile a function for different types at once can
    mix them up.

    Returns:
        The cache's folder, which goes with this object; None where there is one process only.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is None:
        return None
    folder = tempfile.TemporaryDirectory(
        prefix=f"falconwing_numba_{worker}_", ignore_cleanup_errors=True
    )
    os.environ.update(
        {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        | {"NUMBA_CACHE_DIR": folder.name}
    )
    return folder
