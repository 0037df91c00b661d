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


def test_nobody_touches_the_trainer_plug_with_the_throttle_cut_off():
    """Safety rule: the plug is in the back of the radio, so a hand leaves the sticks for it. It is
    pulled while the cut is on, the cut goes off last; and the camera, which gets warm in still air,
    has power for two minutes at a time wherever the list has a battery in.
    """
    steps = load_checklists().preflight.steps
    order = [step.id for step in steps]
    assert order[-2:] == ["trainer_plug", "cut_off"] and steps[-2].stop
    assert "Throttle cut still on" in steps[-2].do and "pull the trainer plug now" in steps[-2].do
    warm = {
        step.id: step.do for step in steps if "camera" in step.do.lower() and step.id != "range"
    }
    assert "without a log: the camera's plug stays out" in warm["propeller"]
    powered = [name for name in ("battery", "picture", "propeller") if "two" in warm.get(name, "")]
    assert powered == ["battery", "picture", "propeller"]
    assert "two minutes at most" in next(step.do for step in steps if step.id == "range")


def test_the_cut_goes_off_only_when_the_flight_s_program_runs():
    """Safety rule: nobody types beside an armed aircraft. The item that frees the motor is the
    last, and the only one that the program does not ask for; chapter 10 starts the recording in
    the step before it.
    """
    steps = load_checklists().preflight.steps
    assert [step.id for step in steps if step.spoken] == ["cut_off"] and steps[-1].spoken
    assert "record" in steps[-1].do and "runs" in steps[-1].do
    chapter = shipped_path("manual/chapters/5_fly.typ", "").read_text(encoding="utf-8")
    begin = chapter.index("falconwing doctor --preflight")
    assert begin < chapter.index("falconwing record --port P") < chapter.index("Item 12")


def test_after_a_flight_the_cut_is_on_before_anyone_walks():
    """Safety rule: the battery cannot be out before somebody is there, so the cut comes first, then
    the word, the way, the plug. In the chapter on repairs, and in the item that frees the motor.
    """
    text = shipped_path("manual/chapters/6_keep.typ", "").read_text(encoding="utf-8")
    said = " ".join(text.split("= Repairs")[1].split("#table(")[0].lower().split())
    order = ["throttle cut on", '"safe"', "walk to it", "battery out", "lift it"]
    at = [said.index(words) for words in order]
    assert at == sorted(at)
    assert "before anyone walks to the aircraft" in load_checklists().preflight.steps[-1].do


def test_the_computer_s_throttle_is_tried_with_the_cut_before_any_propeller():
    """The cut must act on the trainer's throttle too: own step of the bench test, after the
    take-over works, first with the cut on, then off to see that the pulse arrives at all. A no
    stops no flight by hand; `falconwing fly --port` requires every step.
    """
    bench = load_checklists().bench.steps
    order = [step.id for step in bench]
    assert order.index("propeller_off") < order.index("takeover") < order.index("cut_student")
    (step,) = [step for step in bench if step.id == "cut_student"]
    assert step.do.index("cut on") < step.do.index("--turn-motor") < step.do.index("cut off")
    assert not step.stop and "no flight with the computer" in step.if_not


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
        (lambda t: t["preflight"]["steps"][0].update(spoken=True), "spoken ones last"),
        (lambda t: t.pop("preflight"), "preflight"),
        (lambda t: t.update(postflight=t["bench"]), "postflight"),
    ],
)
def test_spoilt_list_is_one_sentence(tmp_path, spoil, text):
    """One change of the shipped file at a time."""
    with pytest.raises(InputError, match=r"mine\.toml") as error:
        load(tmp_path, spoil)
    assert text in str(error.value) and "\n" not in str(error.value)
