"""Story: a student trains a policy on a laptop, is interrupted, goes on, and flies it."""

import json

import numpy as np
import pytest

from falconwing_kit.flight import load_pilot
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.tools.cli.main import main
from tests.learning.halls import thinned_hall

SIZE = "64x48"
GAUSSIANS = 4000  # of the hall's, those that cover most


@pytest.fixture(scope="module")
def small_hall(tmp_path_factory):
    """The hall thinned, so that an image takes a millisecond."""
    path = tmp_path_factory.mktemp("hall") / "small.npz"
    thinned_hall(GAUSSIANS).save(path)
    return path


@pytest.fixture(scope="module")
def trained(small_hall, tmp_path_factory):
    """Half a minute of training, in two rounds."""
    out = tmp_path_factory.mktemp("trained")
    words = ["train", "--out", str(out), "--scene", str(small_hall), "--size", SIZE, "--nominal",
             "--minutes", "0.5", "--flights", "4", "--batch", "4", "--rounds", "2",
             "--device", "cpu"]  # fmt: skip
    assert main(words) == 0
    return out, words


def test_training_writes_weights_a_record_and_a_curve(trained):
    """The first round is flown by the expert, which lands; every round has a finite loss."""
    out, _ = trained
    rounds = json.loads((out / "training.json").read_text())["rounds"]
    assert rounds[0]["success"] == 1.0 and rounds[0]["images"] > 200
    assert all(0.0 < record["loss"] < 2.0 for record in rounds)
    assert (out / "curve.png").stat().st_size > 5000
    assert not (out / "state.safetensors").exists()  # only while it is not finished


def test_the_trained_policy_flies(trained, small_hall, capsys):
    """Half a minute of training does not land; but the loop flies it without a fault, and what it
    does depends on the image.
    """
    out, _ = trained
    code = main(["fly", "--pilot", "student", "--weights", str(out / "policy.safetensors"),
                 "--scene", str(small_hall), "--size", SIZE, "--headless", "--json"])  # fmt: skip
    record = json.loads(capsys.readouterr().out)
    assert code in (0, 1) and record["faults"] == 0
    camera = fpv_camera(64, 48)
    pilot = load_pilot("student", camera=camera, weights=out / "policy.safetensors")
    rng = np.random.default_rng(0)
    image = rng.random((6, 8, 3)).repeat(8, axis=0).repeat(8, axis=1).astype(np.float32)
    features = [pilot.policy.encode(x) for x in (image, image[:, ::-1])]
    assert np.abs(features[0] - features[1]).max() > 0.1


def test_a_finished_training_is_not_repeated_and_another_is_refused(trained, capsys):
    """The same words end at once; others in the same folder are one sentence."""
    out, words = trained
    before = (out / "policy.safetensors").read_bytes()
    assert main(words) == 0
    assert (out / "policy.safetensors").read_bytes() == before
    assert main([*words, "--seed", "7"]) == 2
    assert "got one with another seed; take another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--pilot", "expert", "--weights", "w.safetensors"), "expected none for pilot expert"),
        (("--pilot", "student", "--weights", "none.safetensors"), "found nothing there"),
        (("--pilot", "mask", "--task", "landing"), "got mask, which does not"),
    ],
)
def test_weights_that_do_not_fit_are_one_sentence(words, sentence, capsys):
    """Before anything flies."""
    assert main(["fly", "--headless", *words]) == 2
    assert sentence in capsys.readouterr().err


def test_two_names_of_one_network_are_not_trained_side_by_side(tmp_path, capsys):
    """Before anything is trained or written."""
    out = tmp_path / "trained"
    assert main(["train", "--pilot", "rgb,student", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "--pilot: expected student or rgb, got both, which are one network" in said
    assert not out.exists()
