"""falconwing grade --cluster: a scheduler's workers give the same records as this machine."""

import shutil

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli import grade as grading
from falconwing_kit.tools.cli.grade import Grade
from falconwing_kit.tools.grading.records import last_records, read_grade_records
from falconwing_kit.tools.grading.sandbox.probe import ProbeResult
from tests import clusters
from tests.tools.grading import toys

pytestmark = [toys.needs_sandbox, pytest.mark.timeout(600)]


def test_cluster_gives_the_records_of_this_machine(tmp_path, monkeypatch):
    """Same secret, same cases: record by record the same.

    Each worker's box is tried first, by the worker itself; where one has a hole, nobody is graded.
    The secret is fixed: one in sixteen draws no gain that s1 is wrong for.
    """
    pytest.importorskip("distributed")
    monkeypatch.setattr(
        "falconwing_kit.tools.grading.records.secrets.token_hex", lambda count: "5" * 2 * count
    )
    students = tmp_path / "students"
    students.mkdir()
    half = "def stretch(x, gain):\n    return gain * x + COHORT['offset'] * (gain < 1.5)"
    for n, stretch in enumerate((toys.STRETCH, half, half, toys.STRETCH)):
        (students / f"s{n}.ipynb").write_bytes(toys.notebook_bytes(toys.HEAD, stretch, toys.BRAKE))
    with clusters.running(tmp_path) as (address, start_worker):
        start_worker(), start_worker()
        clusters.wait_for_workers(address, 2)
        assert (
            Grade(str(toys.LAB), (students,), tmp_path / "there", cluster=address, json=True).run()
            == 0
        )
    (tmp_path / "here").mkdir()
    shutil.copy(tmp_path / "there" / "run.json", tmp_path / "here")
    monkeypatch.setattr(grading, "_require_sandbox", lambda: None)
    assert Grade(str(toys.LAB), (students,), tmp_path / "here", workers=1, json=True).run() == 0
    there, here = (last_records(read_grade_records(tmp_path / name)) for name in ("there", "here"))
    assert there == here and len(here) == 4 and 0.0 < here["s1"]["points"] < 75.0


def test_hole_of_one_worker_is_refused(tmp_path, monkeypatch):
    """The sentence names the worker and what is open."""
    found = {"tcp://a": [], "tcp://b": [ProbeResult("network", False, "a listener answered")]}
    monkeypatch.setattr(
        "falconwing_kit.tools.jobs.cluster.run_on_every_worker", lambda function, address: found
    )
    (tmp_path / "ada.ipynb").write_bytes(toys.notebook_bytes(toys.HEAD))
    with pytest.raises(InputError, match=r"got 1 holes \(tcp://b: network: a listener answered\)"):
        Grade(str(toys.LAB), (tmp_path / "ada.ipynb",), tmp_path / "out", cluster="tcp://x").run()
