"""The guards bite: a fault planted in a copy of the kit is reported, with its file."""

import shutil
from pathlib import Path

import pytest

from tests.house.test_docs import doc_problems
from tests.house.test_effects_unknown import effect_problems
from tests.house.test_floors import folder_problems, import_problems, lab_problems
from tests.house.test_names import frame_problems
from tests.house.test_public import PRIVATE, text_problems

ROOT = Path(__file__).resolve().parents[2]
PLANTS = {
    "upward": (import_problems, "core", "import falconwing_kit.aircraft\n", "upward"),
    "upward in a function": (
        import_problems,
        "core",
        "def late() -> None:\n    from falconwing_kit.tools.cli import main\n",
        "core (floor 0) imports tools (floor 5)",
    ),
    "upward from the package": (
        import_problems,
        "aircraft",
        "from falconwing_kit import sysid\n",
        "upward",
    ),
    "sideways": (
        import_problems,
        "aircraft",
        "from falconwing_kit.scene import camera\n",
        "sideways",
    ),
    "relative": (import_problems, "core", "from . import frames\n", "relative"),
    "star": (import_problems, "aircraft", "from falconwing_kit.core.frames import *\n", "star"),
    "unknown room": (import_problems, "core", "import falconwing_kit.attic\n", "attic"),
    "toolbox in the book": (
        import_problems,
        "gap",
        "from falconwing_kit.tools.trials import hidden\n",
        "imports tools",
    ),
    "effect looked up by name": (
        effect_problems,
        "gap",
        "def is_wind(effect: object) -> bool:\n"
        '    """Whether."""\n    return effect == "fan_jet"\n',
        "'fan_jet' belongs to aircraft/effects",
    ),
    "parameter of an effect read": (
        effect_problems,
        "sysid",
        "late = K.control_delay\n",
        "'control_delay' belongs to aircraft/effects",
    ),
    "parameter of an effect set": (
        effect_problems,
        "tools",
        "model = change(stall_loss=0.3)\n",
        "'stall_loss' belongs to aircraft/effects",
    ),
    "mis-met maps": (
        frame_problems,
        "core",
        "p = T_world_body @ T_camera_body\n",
        "body meets camera",
    ),
    "mis-met vector": (
        frame_problems,
        "core",
        "v = R_world_body @ v_world[0]\n",
        "body meets world",
    ),
    "mis-met chain": (
        frame_problems,
        "core",
        "x = T_world_body @ T_body_camera @ p_world\n",
        "camera meets world",
    ),
    "mis-met transpose": (
        frame_problems,
        "core",
        "v = self.R_world_body.T @ state.v_body\n",
        "world meets body",
    ),
    "mis-met row vectors": (
        frame_problems,
        "core",
        "v = vs_world @ Rs_world_body.T\n",
        "world meets body",
    ),
    "misnamed result": (
        frame_problems,
        "core",
        "T_world_marker = T_world_body @ T_body_camera\n",
        "is called",
    ),
    "undocumented function": (
        doc_problems,
        "core",
        "def open_door(width: float) -> None:\n    pass\n",
        "open_door",
    ),
    "undocumented method": (
        doc_problems,
        "core",
        'class A:\n    """A."""\n    def b(self) -> None: ...\n',
        "A.b",
    ),
    "untyped argument": (
        doc_problems,
        "core",
        'def door(width) -> None:\n    """Open."""\n',
        "width",
    ),
}


@pytest.fixture
def copy(tmp_path):
    """The kit's source in a folder of its own."""
    shutil.copytree(
        ROOT / "falconwing_kit",
        tmp_path / "falconwing_kit",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    return tmp_path


@pytest.mark.parametrize("fault", PLANTS)
def test_planted_fault_is_reported(copy, fault):
    """The fault is written here by hand: exactly one report with its file and reason is right."""
    checker, room, code, reason = PLANTS[fault]
    (copy / "falconwing_kit" / room).mkdir(exist_ok=True)
    before = checker(copy)
    (copy / "falconwing_kit" / room / "planted.py").write_text(f'"""A planted fault."""\n{code}')
    reports = [problem for problem in checker(copy) if problem not in before]
    assert len(reports) == 1, reports
    assert f"{room}/planted.py" in reports[0]
    assert reason in reports[0]


def test_room_without_a_door_is_reported(copy):
    """Only a folder with `__init__.py` is installed."""
    attic = copy / "falconwing_kit" / "attic"
    attic.mkdir()
    (attic / "file.py").write_text('"""A file."""\n')
    assert folder_problems(copy) == ["falconwing_kit/attic: no __init__.py"]


def test_lab_that_reaches_behind_a_face_is_reported(tmp_path):
    """By hand: two faces, and two paths behind them."""
    lab = tmp_path / "labs" / "lab99_attic"
    lab.mkdir(parents=True)
    (lab / "lab.py").write_text(
        "from falconwing_kit.core import Pose\nfrom falconwing_kit.tools.grading import check\n"
        "from falconwing_kit.core.frames import pose_matrix\n"
        "from falconwing_kit.tools.grading.lab import Lab\n"
    )
    problems = lab_problems(tmp_path)
    assert [problem.split(": ")[0] for problem in problems] == [
        "labs/lab99_attic/lab.py:3",
        "labs/lab99_attic/lab.py:4",
    ]


def test_right_products_are_not_reported(tmp_path):
    """By hand: each of these meets, or cannot be read from its names."""
    room = tmp_path / "falconwing_kit" / "core"
    room.mkdir(parents=True)
    (room / "right.py").write_text(
        "T_world_camera = T_world_body @ T_body_camera\n"
        "v_world = R_world_body @ v_body\n"
        "vs_body = vs_world @ R_world_body\n"
        "vs_world = vs_body @ R_world_body.T\n"
        "p_body = np.linalg.inv(T_world_body) @ p_world\n"
        "x = R_world_body @ v_max\n"
        "y = gain @ state\n"
    )
    assert frame_problems(tmp_path) == []


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("see /ro" + "ot/notes.txt", "path of one machine"),
        ("--extra-index-" + "url somewhere", "package index"),
        ("x = 1  # TO" + "DO", "unfinished mark"),
    ],
)
def test_private_line_is_reported(tmp_path, line, what):
    """One line of each kind, written here."""
    file = tmp_path / "notes.md"
    file.write_text(f"fine\n{line}\n")
    assert text_problems(tmp_path, [file]) == [f"notes.md:2: {what}"]
    assert what in PRIVATE
