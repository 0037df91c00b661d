"""Trials: continued records, rates and means by hand, mostly in a toy world without an aircraft."""

import csv
import json
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.control.manoeuvres.right_turn_sharp_climb import PLAN
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.sources import RenderedView, fpv_camera
from falconwing_kit.flight.tasks import FollowTask, LandingTask, Spread, TrialSetup
from falconwing_kit.flight.world import PoseNoise
from falconwing_kit.scene import AnalogVideo, GaussianScene, load_scene, scene_link
from falconwing_kit.tools.reports.page import ACCENT, PREDICTED
from falconwing_kit.tools.trials.trial_figures import write_results
from falconwing_kit.tools.trials.trials import (
    TRIALS,
    TrialSettings,
    compare_pilots,
    fly_trial,
    fly_trials,
    read_flown_trials,
    read_paired_trials,
    read_trials,
    study_head,
    summarise_trials,
)


class ToyWorld:
    """A world without motion."""

    leader_state, contact = None, None

    def __init__(self, seed: int) -> None:
        self.seed, self.state = seed, State.from_vector(np.full(9, 0.001 * (seed % 100)))

    def advance(self, t: float) -> None:
        self.t = t

    def measured(self) -> State:
        return self.state

    def send(self, t: float, command: Command) -> None:
        self.command = command


class ToyTask:
    """Half a second; odd seeds fail. Records the seeds of its worlds."""

    name, airframe = "toy", load_airframe()

    def __init__(self) -> None:
        self.made: list[int] = []

    def leader(self, seed: int) -> None:
        """There is none."""

    def trial(self, seed: int) -> TrialSetup:
        self.made.append(seed)
        return TrialSetup(seed, ToyWorld(seed), None, 0.5)

    def judge(self, trial, camera, view=None):
        good = trial.seed % 2 == 0
        return SimpleNamespace(
            watch=lambda step: "done" if step.t > 0.24 else "",
            result=lambda: {
                "success": good,
                "ald_m": 0.1 if good else None,
                "path_m": [[0.0, 0.0, 1.0]],
            },
        )


class Steady:
    """A pilot with a constant command."""

    def act(self, observation) -> Command:
        return Command(0.5, 0.0, 0.0, 0.0)


def steady(trial: TrialSetup) -> Steady:
    return Steady()


def timeless(records: list[dict]) -> list[dict]:
    """Records without run times."""
    return [
        {key: value for key, value in record.items() if not key.startswith("art_")}
        for record in records
    ]


def test_trials_fly_the_frozen_list():
    """Six steps until t = 0.25 in each; seeds 10,000 to 10,003."""
    records = fly_trials(ToyTask(), steady, 4, pilot="steady")
    assert [record["seed"] for record in records] == [10_000, 10_001, 10_002, 10_003]
    assert [record["success"] for record in records] == [True, False, True, False]
    assert {(r["reason"], r["steps"], r["skipped"], r["faults"]) for r in records} == {
        ("done", 6, 0, 0)
    }


def test_an_interrupted_study_is_continued(tmp_path):
    """Ctrl-C in the third flight: two are kept. The second run makes only worlds 2 and 3; the
    records are those of one run.
    """

    def interrupted(trial):
        if trial.seed == 10_002:
            return SimpleNamespace(act=lambda observation: signal.raise_signal(signal.SIGINT))
        return Steady()

    with pytest.raises(KeyboardInterrupt):
        fly_trials(ToyTask(), interrupted, 4, pilot="steady", out=tmp_path / "out", logs=True)
    assert len(read_trials(tmp_path / "out")[1]) == 2
    assert read_flight_log(tmp_path / "out" / "trial_002.mcap").warnings == ()
    task = ToyTask()
    records = fly_trials(task, steady, 4, pilot="steady", out=tmp_path / "out", logs=True)
    assert task.made == [10_002, 10_003]
    assert timeless(records) == timeless(fly_trials(ToyTask(), steady, 4, pilot="steady"))
    assert (
        len(read_flight_log(tmp_path / "out" / "trial_002_take2.mcap").commands) == 7
    )  # and the safe one
    assert (
        len(fly_trials(task, steady, 3, pilot="steady", out=tmp_path / "out")) == 3
    )  # nothing is left to fly
    assert task.made == [10_002, 10_003]


def test_different_studies_are_not_mixed(tmp_path):
    """Another pilot, another list: the message names the difference; the trials are kept."""
    fly_trials(ToyTask(), steady, 2, pilot="steady", out=tmp_path)
    for different in ({"pilot": "other"}, {"pilot": "steady", "seed": 1}):
        with pytest.raises(InputError, match="choose another folder"):
            fly_trials(ToyTask(), steady, 3, out=tmp_path, **different)
    assert len(read_trials(tmp_path)[1]) == 2


NOMINAL = LandingTask(duration=0.1)
FASTER = NOMINAL.model.with_values({"kT": 9.5})  # m/s^2 of thrust, for 9


@pytest.mark.parametrize(
    "changed",
    [
        {"duration": 0.2},
        {"spread": Spread(position=1.0, angle=0.0, speed=1.0)},
        {"model": FASTER},
        {"airframe": replace(NOMINAL.airframe, span=0.8)},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_a_task_of_the_same_name_with_other_numbers_is_not_mixed_in(tmp_path, changed):
    """Two steps of a landing. An equal task continues; one changed number is refused."""
    fly_trials(NOMINAL, steady, 1, pilot="steady", out=tmp_path)
    assert len(fly_trials(LandingTask(duration=0.1), steady, 1, pilot="steady", out=tmp_path)) == 1
    with pytest.raises(
        InputError,
        match="got trials with another duration, spread, noise, delay, model or airframe",
    ):
        fly_trials(replace(NOMINAL, **changed), steady, 2, pilot="steady", out=tmp_path)
    assert len(read_trials(tmp_path)[1]) == 1


CLIMB = "right_turn_sharp_climb"


def lower(rng):
    """The climb's waypoints, 0.1 m lower."""
    return PLAN.waypoints(rng) - (0.0, 0.0, 0.1)


def test_a_changed_leader_is_another_study(tmp_path, monkeypatch):
    """The climb 0.1 m lower, or drawn by another number: refused by name, for continuing and
    pairing.

    A manoeuvre added in front of the table changes nothing.
    """
    task = FollowTask(CLIMB)
    head = study_head(task, "steady")
    (record,) = fly_trials(task, steady, 1, pilot="steady", out=tmp_path, head=head)
    assert record["leader_digest"] == head["leader_digest"]
    kept = MANOEUVRES[CLIMB]
    table = {"new": replace(kept, name="new", frozen_number=None), **MANOEUVRES}
    monkeypatch.setattr("falconwing_kit.control.leader.MANOEUVRES", table)
    assert study_head(task, "steady") == head
    assert len(read_paired_trials(tmp_path, head)) == 1
    for change in ({"waypoints": lower}, {"frozen_number": 9}):
        table[CLIMB] = replace(kept, **change)
        other = study_head(task, "steady")
        assert other["task_digest"] != head["task_digest"]
        for refuse in (read_flown_trials, read_paired_trials):
            with pytest.raises(
                InputError, match="got trials with another leader's path; choose another folder"
            ):
                refuse(tmp_path, other)


def test_a_study_without_the_leaders_digest_is_refused(tmp_path):
    """Earlier versions wrote no leader_digest, so their leader is unknown."""
    fly_trials(FollowTask(CLIMB), steady, 1, pilot="steady", out=tmp_path)
    head, *records = (tmp_path / TRIALS).read_text().splitlines()
    old = {key: value for key, value in json.loads(head).items() if key != "leader_digest"}
    (tmp_path / TRIALS).write_text("\n".join([json.dumps(old), *records]) + "\n")
    for refuse in (read_flown_trials, read_paired_trials):
        with pytest.raises(
            InputError, match="no digest of the leader's path, as earlier versions of the kit wrote"
        ):
            refuse(tmp_path, study_head(FollowTask(CLIMB), "steady"))


@pytest.mark.parametrize("world", ["PoseNoise", "LINK_DELAY_S"])
def test_trials_of_a_noisier_or_later_world_are_not_mixed_in(tmp_path, monkeypatch, world):
    """Ten times the noise, or a delay 50 ms longer."""
    fly_trials(ToyTask(), steady, 1, pilot="steady", out=tmp_path)
    other = {"PoseNoise": lambda: PoseNoise(position=0.1), "LINK_DELAY_S": 0.1}[world]
    monkeypatch.setattr(f"falconwing_kit.tools.trials.trials.{world}", other)
    with pytest.raises(InputError, match="noise, delay"):
        fly_trials(ToyTask(), steady, 2, pilot="steady", out=tmp_path)


def test_another_scene_or_lens_is_another_setting():
    """One Gaussian moved by a metre; the image centre moved by a pixel. Equal ones stay equal."""
    camera = fpv_camera(16, 16)
    nominal = TrialSettings(one_gaussian(2.0), camera).record
    assert TrialSettings(one_gaussian(2.0), camera).record == nominal
    for other in (
        TrialSettings(one_gaussian(3.0), camera),
        TrialSettings(one_gaussian(2.0), replace(camera, cx=camera.cx + 1.0)),
        TrialSettings(one_gaussian(2.0), camera, link=AnalogVideo(30.0)),
    ):
        assert other.record != nominal


def test_digests_of_shipped_scenes_stay_those_of_earlier_studies():
    """Recorded with version 0.1, in which the link was a part of the scene."""
    direct = TrialSettings(load_scene("hall"))
    analog = TrialSettings(load_scene("hall_analog"), link=scene_link("hall_analog"))
    assert direct.record["scene_digest"] == "7eb526def3ea0a0e"
    assert analog.record["scene_digest"] == "646edb0a6bb0afe1"


def test_every_trial_draws_the_noise_of_its_own_link(monkeypatch):
    """The link's seed is the trial's, 10,000 and 10,001: frames of two trials differ in noise."""
    views = []

    class KeptView(RenderedView):
        def __init__(self, *parts, **named) -> None:
            super().__init__(*parts, **named)
            views.append(self)

    monkeypatch.setattr("falconwing_kit.tools.trials.trials.RenderedView", KeptView)
    setting = TrialSettings(one_gaussian(2.0), fpv_camera(16, 16), link=AnalogVideo(30.0, seed=3))
    fly_trials(ToyTask(), steady, 2, pilot="steady", setting=setting)
    assert [view.link for view in views] == [
        AnalogVideo(30.0, seed=seed) for seed in (10_000, 10_001)
    ]


def one_gaussian(x: float) -> GaussianScene:
    return GaussianScene(
        [[x, 0.0, 1.0]], [[1.0, 0.0, 0.0, 0.0]], np.full((1, 3), 0.1), [0.9], np.zeros((1, 1, 3))
    )


GOOD = (
    '{"trial": 0, "success": true, "seed": 10000, "reason": "done", "steps": 2, "skipped": 0'
    ', "faults": 0, "art_median_ms": 1, "art_p95_ms": 2, "art_ms": [1, 2], "machine": "none"'
    ', "images": "no images", "ald_m": 0.1, "ate_path_m": 0.2, "path_m": [[0, 0, 1]]'
    ', "leader_path_m": [[4, 0, 1]], "lost_at_s": null'
)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ('{"trial": 0, "success": true}', "reason null"),
        (f'{GOOD}, "ald_m": "x"}}', 'ald_m "x"'),
        (f'{GOOD}, "ald_m": NaN}}', "ald_m NaN"),
        (f'{GOOD}, "faults": -1}}', "faults -1"),
        (f'{GOOD}, "faults": 1}}', "first_fault null"),
        (f'{GOOD}, "seed": [1]}}', "seed"),
        (f'{GOOD}, "steps": true}}', "steps true"),
        (f'{GOOD}, "art_ms": []}}', "art_ms"),
        (f'{GOOD}, "art_ms": [1, null]}}', "art_ms"),
        (f'{GOOD}, "path_m": [[1, 2]]}}', "path_m"),
        (f'{GOOD}, "lost_at_s": "late"}}', 'lost_at_s "late"'),
        (f'{GOOD}, "locked_share": {{}}}}', "locked_share"),
        (f'{GOOD}, "success": 1}}', "success 1"),
    ],
)
def test_a_damaged_measure_is_named(tmp_path, line, fault):
    """A good head and one wrong value (of equal keys JSON takes the last). Without it the record is
    read.
    """
    head = '{"task": "landing", "list": 0}\n'
    (tmp_path / "trials.jsonl").write_text(f"{head}{line}\n")
    with pytest.raises(InputError) as refused:
        read_trials(tmp_path)
    assert f"got trial 0 with {fault}" in str(refused.value)
    (tmp_path / "trials.jsonl").write_text(f"{head}{GOOD}}}\n")
    found = summarise_trials(read_trials(tmp_path)[1])
    assert (found["ald_m"]["mean"], found["ate_path_m"]["mean"]) == pytest.approx((0.1, 0.2))


@pytest.mark.parametrize(
    "damage", ["", "{}\n[1]\n", '{"task": 1}\n{"trial": 1, "success": true}\n', "no json\n"]
)
def test_a_damaged_record_is_refused(tmp_path, damage):
    """Empty, a list, a missing trial, other text."""
    (tmp_path / "trials.jsonl").write_text(damage)
    with pytest.raises(InputError, match="expected a head and then trials"):
        read_trials(tmp_path)
    with pytest.raises(FileNotFoundError, match="found none there"):
        read_trials(tmp_path / "nowhere")


def test_faults_of_a_pilot_are_recorded():
    """It raises in every step: six faults, and the first reason is kept."""

    def broken(trial):
        return SimpleNamespace(act=lambda observation: 1 / 0)

    record = fly_trial(ToyTask(), broken, 0)
    assert record["faults"] == 6
    assert "ZeroDivisionError" in record["first_fault"]["error"]


def test_a_pilot_by_images_gets_no_state():
    """The others get one; what it sees can be made worse on the way, by the trial's seed."""
    seen = []

    def pilot(reads_state):
        def act(observation):
            seen.append((observation.state is None, observation.image))
            return Command(0.5, 0.0, 0.0, 0.0)

        return lambda trial: SimpleNamespace(act=act, reads_state=reads_state)

    class Late:
        """Images that arrive two steps late."""

        def __init__(self, source, seed):
            assert seed == 10_000
            self.source, self.images = source, []

        def next_image(self, t):
            self.images.append(self.source.next_image(t))
            return self.images[-3] if len(self.images) > 2 else None

    setting = TrialSettings(one_gaussian(2.0), fpv_camera(16, 16), degrade=Late)
    fly_trial(ToyTask(), pilot(True), 0, setting=setting)
    assert [without for without, _ in seen] == [False] * 6
    seen.clear()
    fly_trial(ToyTask(), pilot(False), 0, setting=setting)
    assert [without for without, _ in seen] == [True] * 6
    times = [None if image is None else round(image.t, 2) for _, image in seen]
    assert times == [None, None, 0.0, 0.05, 0.1, 0.15]
    with pytest.raises(InputError, match="scene: expected one to render"):
        fly_trial(ToyTask(), pilot(False), 0)


def test_a_log_is_marked_as_simulated(tmp_path):
    """With task and seed, and the hall and pilot that it was given."""
    setting = TrialSettings(scene_name="hall")
    fly_trial(ToyTask(), steady, 1, 0, setting, tmp_path / "flight.mcap", "by hand")
    metadata = read_flight_log(tmp_path / "flight.mcap").metadata
    assert metadata.items() >= {"simulated": "yes", "task": "toy", "seed": "10001"}.items()
    assert (metadata["scene"], metadata["pilot"], metadata["manoeuvre"]) == ("hall", "by hand", "")


def record(success: bool, **numbers) -> dict:
    art = {
        "art_median_ms": 1.0,
        "art_p95_ms": 2.0,
        "art_ms": [1.0, 2.0],
        "machine": "a",
        "images": "no images",
    }
    return {"success": success, "faults": 0, "skipped": 0, **art, **numbers}


def test_deviation_counts_landings_only():
    """Deviations 0.1, 0.2, 0.6 of three landings, a failure 5 m off: mean 0.3, not 0.225 and not
    1.475. / 3 of 4: exact 95 % limits 19.4 and 99.4 % (Geigy tables). Absolute bank: (2 + 4 + 3) /
    3.
    """
    landings = [(0.1, 2.0), (0.2, -4.0), (0.6, 3.0)]
    records = [record(True, ald_m=ald, bank_deg=bank) for ald, bank in landings]
    found = summarise_trials(
        [*records, record(False, ald_m=None, lateral_offset_m=5.0, bank_deg=40.0)]
    )
    assert (found["successes"], found["trials"], found["success_rate"]) == (3, 4, 0.75)
    assert 100.0 * found["success_low95"] == pytest.approx(19.4, abs=0.06)
    assert 100.0 * found["success_high95"] == pytest.approx(99.4, abs=0.06)
    assert found["ald_m"]["mean"] == pytest.approx(0.3)
    assert (found["ald_m"]["median"], found["ald_m"]["of"]) == (0.2, 3)
    assert found["ald_m"]["low95"] < 0.3 < found["ald_m"]["high95"]
    assert found["bank_abs_deg"]["mean"] == pytest.approx(3.0)


def test_run_times_are_pooled_over_steps():
    """20 steps of 1 ms in one trial, 2 of 9 ms in another: the median step takes 1 ms, not 5; 95 %
    are within 9 ms.

    The 95th percentile of 22 sorted values lies at index 0.95 * 21 = 19.95: 1 + 0.95 * 8 = 8.6 ms.
    """
    trials = [
        record(True, art_ms=[1.0] * 20, machine="a"),
        record(True, art_ms=[9.0] * 2, machine="b"),
    ]
    found = summarise_trials(trials)
    assert (found["art_median_ms"], found["art_steps"]) == (1.0, 22)
    assert found["art_p95_ms"] == pytest.approx(8.6)
    assert (found["machine"], found["images"]) == ("a; b", "no images")


def test_a_record_keeps_the_run_time_of_every_step():
    """A pilot that sleeps 2 ms in each of six steps; 16x16 images by the flights' renderer, or
    none.
    """

    def slow(trial):
        return SimpleNamespace(
            act=lambda observation: time.sleep(0.002) or Command(0.5, 0.0, 0.0, 0.0)
        )

    found = fly_trial(ToyTask(), slow, 0)
    assert len(found["art_ms"]) == found["steps"] == 6
    assert all(ms >= 2.0 for ms in found["art_ms"])
    assert found["images"] == "no images"
    assert "cores" in found["machine"]
    with_images = fly_trial(
        ToyTask(), steady, 0, setting=TrialSettings(one_gaussian(2.0), fpv_camera(16, 16))
    )
    assert with_images["images"].startswith("16x16 images by ")


def test_tracking_error_is_averaged_over_all_and_over_successes():
    """0.2, 0.4 of successes, 0.9 until a loss, and a trial without a lock: means 0.5 and 0.3."""
    records = [
        record(True, ate_m=0.2),
        record(True, ate_m=0.4),
        record(False, ate_m=0.9),
        record(False, ate_m=None),
    ]
    found = summarise_trials(records)
    assert found["ate_m"]["mean"] == pytest.approx(0.5)
    assert found["ate_m_of_successes"]["mean"] == pytest.approx(0.3)
    none = summarise_trials([record(False, ald_m=None, sink_rate_m_s=3.0)])
    assert none["successes"] == 0
    assert np.isnan(none["sink_rate_m_s"]["mean"])


def test_pilots_are_compared_on_the_same_starts():
    """Five common seeds: two won by the first alone, none by the second: p = 2 (1/2)^2 = 0.5."""
    first = [{"seed": k, "success": k != 4} for k in range(6)]
    second = [{"seed": k, "success": k not in (0, 1, 4)} for k in range(5)]
    found = compare_pilots(first, second)
    assert found == {"pairs": 5, "only_first": 2, "only_second": 0, "p_value": pytest.approx(0.5)}
    with pytest.raises(InputError, match="same starts"):
        compare_pilots(first, [{"seed": 99, "success": True}])


def test_pilots_behind_different_leaders_are_not_compared():
    """Leaders differ in the second of two trials; records of earlier versions have no digest."""
    first = [{"seed": k, "success": True, "leader_digest": f"a{k}"} for k in range(2)]
    second = [first[0], {**first[1], "leader_digest": "b1"}]
    with pytest.raises(InputError, match="different ones at seed 1"):
        compare_pilots(first, second)
    assert compare_pilots(first, [{"seed": k, "success": True} for k in range(2)])["pairs"] == 2


def test_results_are_written_with_both_colours(tmp_path):
    """A success and a failure: both colours in both figures; the table has a row each without
    paths.
    """
    import matplotlib.image

    paths = [[[-19.0, y, 1.5], [0.0, y, 0.5], [4.0, y, 0.2]] for y in (-2.0, 5.0)]
    flown = [(True, 0.1, paths[0]), (False, None, paths[1])]
    records = [
        record(
            good,
            trial=k,
            ald_m=ald,
            ate_path_m=0.2,
            lateral_offset_m=0.1,
            past_threshold_m=3.0,
            path_m=path,
        )
        for k, (good, ald, path) in enumerate(flown)
    ]
    files = write_results(records, summarise_trials(records), tmp_path, "landing by expert")
    bars = (255 * matplotlib.image.imread(files["results"])[..., :3]).round()
    for colour in (PREDICTED, ACCENT):
        assert (bars == [int(colour[i : i + 2], 16) for i in (1, 3, 5)]).all(axis=-1).sum() > 100
    red, _, blue = np.moveaxis(matplotlib.image.imread(files["paths"])[..., :3], -1, 0)
    assert ((blue - red) > 0.35).sum() > 50  # the path that landed; the pad is paler
    assert ((red - blue) > 0.35).sum() > 50
    with files["table"].open() as file:
        rows = list(csv.DictReader(file))
    assert [row["success"] for row in rows] == ["True", "False"]
    assert not {"path_m", "art_ms"} & set(rows[0])
    assert rows[0]["ate_path_m"] == "0.2"  # an error along the path, not a path
    assert json.loads(files["summary"].read_text())["successes"] == 1


def test_the_expert_lands_in_the_real_task():
    """The paper's state-based expert landed ten of ten; here two starts of an unused list."""
    task = LandingTask()
    records = fly_trials(task, task.expert, 2, pilot="expert", seed=500)
    assert [record["success"] for record in records] == [True, True]
    assert all(len(record["path_m"]) == record["steps"] for record in records)
