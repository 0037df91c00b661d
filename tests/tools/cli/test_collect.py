"""`falconwing collect`: a dataset, gone on with after Ctrl-C, and the options that it refuses."""

import json

import pytest

from falconwing_kit.learning.datasets import Dataset
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.trials import collect_dataset
from falconwing_kit.vision.policy import Policy


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    """Three flights in files of one, in a hall of very few Gaussians."""
    path = tmp_path_factory.mktemp("hall") / "tiny.npz"
    hall = load_scene("hall")
    hall.selected(hall.opacities >= sorted(hall.opacities)[-300]).save(path)
    return ["collect", "--flights", "3", "--per-file", "1", "--size", "24x16", "--nominal",
            "--scene", str(path), "--device", "cpu"]  # fmt: skip


@pytest.fixture(scope="module")
def folder(words, tmp_path_factory):
    """A dataset that was not interrupted."""
    out = tmp_path_factory.mktemp("whole") / "flights"
    assert main([*words, "--out", str(out)]) == 0
    return out


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}


def test_an_interrupted_collection_goes_on_to_the_same_dataset(
    words, folder, tmp_path, monkeypatch, capsys
):
    """Ctrl-C in the second file: exit code 130, one flight on the disk and no more; the same
    command then ends with the same bytes as one that was never interrupted.
    """
    out, fly = tmp_path / "flights", collect_dataset.fly_episodes
    calls = []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return fly(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(collect_dataset, "fly_episodes", interrupted)
        assert main([*words, "--out", str(out)]) == 130
    assert len(list(out.rglob("data/*/*.parquet"))) == 1
    assert main(["train", "--data", str(out), "--size", "24x16", "--out", str(tmp_path / "t")]) == 2
    assert "of 3 flights, got the first 1; give the same falconwing" in capsys.readouterr().err
    assert main([*words, "--out", str(out), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["flights"] == 3 and record["success"] == 1.0 and record["simulated"]
    assert content(out) == content(folder)


def test_every_flight_has_a_seed_of_its_own(folder):
    """Counted from the seed of the collection, beyond those of training and evaluation."""
    seeds = [row["seed"] for row in Dataset(folder).episodes]
    assert seeds == [5_000_000_000, 5_000_000_001, 5_000_000_002]


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--seed", "1"], "got one of other seed; take another folder"),
        (["--flights", "4"], "got one of other flights; take another folder"),
        (["--flights", "0"], "--flights: expected a finite number in [1, 1e+06], got 0"),
        (["--expert-noise", "2"], "--expert-noise: expected a finite number in [0, 1], got 2"),
        (["--size", "8x8"], "--size: expected sides of 16 to 1920 pixels, got 8x8"),
        (["--weights", "none.safetensors"], "none.safetensors: expected a file, found nothing"),
        (["--scene", "nowhere"], "nowhere"),
    ],
)
def test_other_options_are_one_sentence(words, folder, more, sentence, capsys):
    """And the dataset that is there stays as it is."""
    before = content(folder)
    assert main([*words, "--out", str(folder), *more]) == 2
    err = capsys.readouterr().err
    assert sentence in err and err.count("\n") == 1
    assert content(folder) == before


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--task", "follow", "--size", "24x16"], "of the task follow, got landing; take another"),
        (["--size", "64x48"], "expected images of 64x48, got 24x16; use --size 24x16"),
        (["--size", "24x16", "--data", "nothing"], "expected a dataset of falconwing collect"),
    ],
)
def test_a_dataset_that_does_not_fit_is_one_sentence(folder, more, sentence, tmp_path, capsys):
    """Before anything is trained or written."""
    out = tmp_path / "trained"
    assert main(["train", "--data", str(folder), "--out", str(out), *more]) == 2
    assert sentence in capsys.readouterr().err and not out.exists()


def test_rounds_may_be_none_only_with_a_dataset(tmp_path, capsys):
    """Else there would be nothing to learn from."""
    assert main(["train", "--rounds", "0", "--out", str(tmp_path)]) == 2
    assert "--rounds: expected a finite number in [1, 10000], got 0" in capsys.readouterr().err


@pytest.mark.parametrize("memory", [True, False])
def test_cloning_comes_before_the_rounds(words, folder, tmp_path, memory):
    """Two steps on the dataset, then a round in which the policy flies: its own images follow."""
    words = ["train", "--data", str(folder), "--size", "24x16", "--steps", "2", "--rounds", "1",
             "--minutes", "0.02", "--flights", "2", "--batch", "2", "--nominal", "--scene",
             words[words.index("--scene") + 1], "--device", "cpu",
             "--out", str(tmp_path)]  # fmt: skip
    assert main(words if memory else [*words, "--no-memory"]) == 0
    rounds = json.loads((tmp_path / "training.json").read_text())["rounds"]
    assert [record["round"] for record in rounds] == [0, 1, 2]
    assert [record["steps"] for record in rounds[:2]] == [1, 2] and rounds[2]["steps"] > 2
    assert rounds[2]["mixing"] == 0.0  # the policy flies, not the expert
    assert sorted(record["s"] for record in rounds) == [record["s"] for record in rounds]
    assert bool(Policy.load(tmp_path / "policy.safetensors").shape.memory) is memory
