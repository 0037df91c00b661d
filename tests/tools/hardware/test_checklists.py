"""The checklists are complete, in a safe order, and a spoilt file gives one sentence."""

import tomllib

import pytest
import tomli_w

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import shipped_path
from falconwing_kit.tools.hardware.checklists import load_checklists


def load(folder, spoil):
    table = tomllib.loads(shipped_path("hardware/checklists.toml", "").read_text(encoding="utf-8"))
    spoil(table)
    (folder / "mine.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    return load_checklists(folder / "mine.toml")


def test_propeller_comes_off_first_and_on_late():
    """Safety rule of firmware/README.md: off until everything else of the bench is done, on when
    all checks passed.
    """
    lists = load_checklists()
    assert lists.bench.steps[0].id == "propeller_off" and lists.bench.steps[0].stop
    order = [step.id for step in lists.preflight.steps]
    assert all(
        order.index(name) < order.index("propeller")
        for name in ("picture", "board", "takeover", "range")
    )
    assert "propeller" not in [step.id for step in lists.bench.steps]


def test_whatever_takes_the_aircraft_back_must_pass():
    """The radio's switch is the real takeover: no list goes on when it, or the loss of the
    computer, failed.
    """
    lists = load_checklists()
    for checklist, names in (
        (lists.bench, ("takeover", "computer_lost", "plug_pulled")),
        (lists.preflight, ("takeover",)),
    ):
        assert all(step.stop for step in checklist.steps if step.id in names)
        assert {step.id for step in checklist.steps} >= set(names)


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda t: t["bench"]["steps"][0].update(see=""), "propeller_off"),
        (lambda t: t["bench"]["steps"][0].update(stop="always"), "stop"),
        (lambda t: t["bench"]["steps"][1].update(id="propeller_off"), "every id once"),
        (lambda t: t["bench"]["steps"][4].update(automatic="colour"), "board, sticks, picture"),
        (lambda t: t["bench"].update(steps=[]), "at least one"),
        (lambda t: t.pop("preflight"), "preflight"),
        (lambda t: t.update(postflight=t["bench"]), "postflight"),
    ],
)
def test_spoilt_list_is_one_sentence(tmp_path, spoil, text):
    """One change of the shipped file at a time."""
    with pytest.raises(InputError, match=r"mine\.toml") as error:
        load(tmp_path, spoil)
    assert text in str(error.value) and "\n" not in str(error.value)
