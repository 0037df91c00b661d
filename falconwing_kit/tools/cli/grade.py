"""falconwing grade, falconwing sandbox: submissions -> records and a gradebook; the box they run in
-> does it hold?
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.tools.grading.judge import Assignment
    from falconwing_kit.tools.grading.lab import Lab
    from falconwing_kit.tools.grading.submissions import Submission

Records = dict[str, dict[str, Any]]  # by student


@dataclass(frozen=True)
class Grade:
    """Grade a lab: every function in a box of its own, on cases that nobody has seen.

    Writes a record of each submission as soon as it is graded, and gradebook.csv. Exit code 1 when
    a submission could not be graded and a person must look.
    """

    lab: Annotated[str, tyro.conf.Positional]
    """such as lab03"""
    submissions: Annotated[Path, tyro.conf.Positional]
    """a notebook, a folder of notebooks or of students' folders, or a learning platform's zip"""
    out: Path
    """folder for the records and the gradebook"""
    workers: int = 2
    """submissions at a time"""
    cluster: str = ""
    """address of a scheduler of `distributed` whose workers grade instead, such as
    tcp://10.0.0.5:8786
    """
    resume: bool = False
    """go on with an earlier run: what is graded already is left as it is"""
    regrade: bool = False
    """grade again what is recorded, on the very same cases, and say what changed"""
    salt: str = ""
    """the course's secret that `labs release` was given"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    unsafe_no_sandbox: bool = False
    """run students' code in plain processes that can do all that you can; stamped on every record
    """
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Grade.

        Returns:
            0 where every submission was graded or is unreadable, 1 where a person must look at one.

        Raises:
            InputError: a folder, lab or option cannot be used, or the box has a hole.
        """
        from falconwing_kit.tools.grading.find import lab_folder, load_checks
        from falconwing_kit.tools.grading.judge import Assignment
        from falconwing_kit.tools.grading.records import (
            last_records,
            open_run,
            read_grade_records,
            write_points_table,
        )
        from falconwing_kit.tools.grading.sandbox.limits import sweep
        from falconwing_kit.tools.grading.submissions import find_submissions

        require_range("--workers", self.workers, low=1, high=256)
        folder = lab_folder(self.lab, self.labs).resolve()
        lab = load_checks(folder)
        found = find_submissions(self.submissions, lab.name)
        sandboxed = not self.unsafe_no_sandbox
        if sandboxed and self.cluster:
            _require_worker_sandboxes(self.cluster)
        elif sandboxed:
            _require_sandbox()
        secret = open_run(
            self.out, lab.name, self.salt, sandboxed=sandboxed, go_on=self.resume or self.regrade
        )
        known = last_records(read_grade_records(self.out))
        sweep()
        try:
            counts = self._grade(
                Assignment(folder, self.salt, secret, sandboxed), lab, found, known
            )
        finally:
            sweep()
            records = last_records(read_grade_records(self.out))
            book = write_points_table(
                self.out, [exercise.name for exercise in lab.exercises], records.values()
            )
        return self._report(lab, list(records.values()), counts | {"gradebook": str(book)})

    def _grade(
        self, assignment: "Assignment", lab: "Lab", found: "list[Submission]", known: Records
    ) -> dict[str, Any]:
        """Grade what is to be graded, record it at once, and count."""
        from tqdm import tqdm

        from falconwing_kit.tools.grading.judge import GradingTask, error_record, grade_submission
        from falconwing_kit.tools.grading.records import append_record
        from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map

        todo, before = [], {each.student: known.get(each.student, {}) for each in found}
        for each in found:
            same = (
                before[each.student].get("sha256") == each.sha256
                and before[each.student].get("status") != "error"
            )
            if not same or self.regrade:
                todo.append(GradingTask(each, before[each.student]["seed"] if same else ""))
        changed = 0
        done = parallel_map(
            partial(grade_submission, assignment=assignment), todo, self.workers, self.cluster
        )
        for work, result in tqdm(
            done, total=len(todo), desc=lab.name, unit="submission", disable=None
        ):
            if isinstance(result, WorkerLostError):
                result = error_record(work, assignment, lab) | {"problem": str(result)}
            if result != before[work.submission.student]:
                append_record(self.out, result)
                changed += 1
        gone = len(set(known) - set(before))
        return {
            "graded_now": len(todo),
            "left": len(found) - len(todo),
            "changed": changed,
            "not_found": gone,
        }

    def _report(self, lab: "Lab", records: list[dict[str, Any]], counts: dict[str, Any]) -> int:
        """Print what came out; 1 where a person must look."""
        failed = [record for record in records if record["status"] == "error"]
        marked = [record for record in records if record["status"] == "graded"]
        rows = []
        for exercise in lab.exercises:
            results = [record["exercises"][exercise.name] for record in marked]
            mean = sum(each["points"] for each in results) / max(len(results), 1)
            rows.append(
                (
                    exercise.name,
                    exercise.points,
                    mean,
                    sum(each["right"] == each["cases"] for each in results),
                )
            )
        if self.json:
            states = [record["status"] for record in records]
            by_status = {state: states.count(state) for state in ("graded", "unreadable", "error")}
            means = {name: mean for name, _, mean, _ in rows}
            print_json(
                {
                    "lab": lab.name,
                    "sandboxed": not self.unsafe_no_sandbox,
                    **by_status,
                    **counts,
                    "mean": means,
                }
            )
            return int(bool(failed))
        title = f"{lab.name}: {len(marked)} of {len(records)} submissions graded, {counts['graded_now']} of them now"
        print_table(("exercise", "points", "mean", "all right"), rows, title=title)
        if self.regrade:
            print(
                f"regraded {counts['graded_now']}, {counts['changed']} of them differ from their record"
            )
        for record in records:
            if record["status"] != "graded" or record["problem"]:
                print(f"! {record['student']}: {record['status']}: {record['problem']}")
        if self.unsafe_no_sandbox:
            print("! graded without a box: these points can be forged")
        next_line(
            f"open {counts['gradebook']}; a person's points, for figures and answers, are not in it"
        )
        return int(bool(failed))


@dataclass(frozen=True)
class Sandbox:
    """Try to get out of the grader's box, in every way that a student might.

    Exit code 0 where it holds, 1 where it has a hole; `grade` then refuses.
    """

    action: Annotated[Literal["probe"], tyro.conf.Positional]
    """probe: try it"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Probe.

        Returns:
            0 where everything is closed, else 1.

        Raises:
            InputError: bubblewrap is missing.
        """
        from falconwing_kit.tools.grading.sandbox.probe import probe_sandbox

        findings = probe_sandbox()
        if self.json:
            print_json(
                {
                    "closed": all(each.closed for each in findings),
                    "tried": [asdict(each) for each in findings],
                }
            )
        else:
            rows = [
                (each.name, "closed" if each.closed else "OPEN", each.said) for each in findings
            ]
            print_table(("what was tried", "box", "found"), rows)
            held = all(each.closed for each in findings)
            next_line(
                "falconwing grade lab01 SUBMISSIONS --out grades" if held else "falconwing doctor"
            )
        return int(not all(each.closed for each in findings))


def _require_sandbox() -> None:
    """Refuse to grade in a box that does not hold."""
    from falconwing_kit.tools.grading.sandbox.probe import open_holes, probe_sandbox

    _refuse_holes(open_holes(probe_sandbox()))


def _require_worker_sandboxes(cluster: str) -> None:
    """Refuse to grade where the box of any worker of a cluster does not hold."""
    from falconwing_kit.tools.grading.sandbox.probe import open_holes, probe_sandbox
    from falconwing_kit.tools.jobs.cluster import run_on_every_worker

    tried = run_on_every_worker(probe_sandbox, cluster)
    _refuse_holes(
        [f"{worker}: {hole}" for worker, findings in tried.items() for hole in open_holes(findings)]
    )


def _refuse_holes(found: Sequence[str]) -> None:
    if found:
        advice = "mend it (`falconwing sandbox probe` says more), or accept forged points with --unsafe-no-sandbox"
        raise InputError(
            f"the box: expected it closed, found {len(found)} holes ({'; '.join(found)}); {advice}"
        )
