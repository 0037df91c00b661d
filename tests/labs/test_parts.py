"""The labs' switch PARTS: what a student wrote in earlier labs does the work of the later ones."""

import numpy as np
import pytest

from falconwing_kit.scene import GaussianScene
from falconwing_kit.tools.grading import load_parts, whose
from falconwing_kit.tools.grading.find import importable_given, lab_folder, load_module
from falconwing_kit.tools.grading.notebooks import read_cells
from tests.labs.test_fly_your_own import ROOT, mixture

SWITCHED = ("lab06", "lab08", "lab11", "lab13")


@pytest.fixture(scope="module")
def parts():
    """The kit's parts, in the place of a student's."""
    return load_parts("kit")


def given_of(lab):
    """The given code of a lab."""
    folder = lab_folder(lab, ROOT / "labs")
    with importable_given(load_module(folder, "given")) as module:
        return module


@pytest.mark.parametrize("lab", SWITCHED)
def test_the_switch_is_the_first_line_of_code_and_stands_on_the_kits(lab):
    """A student finds it at the top; nothing is collected before it is asked for."""
    cells = read_cells(lab_folder(lab, ROOT / "labs") / "lab.py")
    first = next(cell for cell in cells if not cell.markdown)
    assert first.text.startswith('PARTS = "kit"')
    assert "collect-mine" in first.text.splitlines()[0] and "load_parts(PARTS)" in first.text


def test_a_lab_says_whose_each_part_is(tmp_path):
    """Every function of the two modules once, on its owner's side; without parts: the lab's own."""
    package, choices = mixture(tmp_path / "mixed", 2)
    said = whose(package, "expert", "renderer")
    for each in choices:
        if each.part in ("expert", "renderer"):
            (line,) = [line for line in said.splitlines() if line.startswith(f"{each.part}:")]
            kits = line.partition("the kit's")[2]
            assert each.function in line and (each.function in kits) != each.mine
    assert "the lab's own" in whose(None, "expert")


def test_lab_2_polishes_as_lab_6_does(parts):
    """Both minimise the same misfit, so they end in the same pose; 0.1 mm of several metres."""
    given = given_of("lab06")
    photos = given.read_photos()
    for corners_px in photos["corners_px"][::18]:
        rough = parts.poses.marker_pose(corners_px, given.K, given.MARKER_SIZE)
        own = given.polish(rough, corners_px, parts=parts)
        assert own == pytest.approx(given.polish(rough, corners_px), abs=1e-4)
        assert np.abs(own - rough).max() > 1e-3  # it did something


def test_lab_3_draws_what_lab_8s_network_sees(parts):
    """Beside the kit's renderer: mean difference below 1.5 of 255 (lab 3's splats end earlier)."""
    given = given_of("lab08")
    scene = GaussianScene.load(ROOT / "labs/lab08_imitation/data/arena_small.npz")
    kit, own = given.camera_view(scene), given.own_view(parts, scene)
    flight = given.Flight(0.5, 0.05, 0.0, -1)
    for _ in range(3):
        difference = kit(flight).astype(float) - own(flight)
        assert np.abs(difference).mean() < 1.5
        for _ in range(15):
            flight.fly(given.expert(flight))
    other = given.Flight(-0.5, -0.05, 0.0, -1)  # the tolerance sees 1 m and 6 degrees
    assert np.abs(kit(given.Flight(0.5, 0.05, 0.0, -1)).astype(float) - own(other)).mean() > 6.0


def test_lab_7_lands_where_lab_8_tests(parts):
    """Its guidance leads to the line from both sides; of twenty gusty flights most land."""
    given = given_of("lab08")
    landed = 0
    for start in given.test_starts():
        flight = given.Flight(*start)
        while not flight.over:
            flight.fly(given.expert(flight, parts))
        landed += not flight.lost and abs(flight.offset) <= given.PAD_HALF
    assert landed >= 16


def test_lab_7_flies_the_landings_of_lab_11(parts):
    """Its expert lands on the pad, 2 m wide, within half a metre; other seeds, other numbers."""
    flown = given_of("lab11").fly_landings(parts, 3)
    assert flown["success"].tolist() == [1.0, 1.0, 1.0]
    assert (flown["ald_cm"] < 50.0).all() and len(set(flown["ald_cm"])) == 3
