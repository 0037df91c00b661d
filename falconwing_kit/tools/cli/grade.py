"""falconwing grade: grade a class, every function in a sandbox."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.tools.grading.judge import Assignment
    from falconwing_kit.tools.grading.lab import Lab
    from falconwing_kit.tools.grading.roster import HandIns

Records = dict[str, dict[str, Any]]  # by student


@dataclass(frozen=True)
class Grade:
    """Grade a lab: every function in a sandbox of its own, on unpublished test cases.

    Writes a record of each submission as soon as it is graded, and gradebook.csv. Exit code 1 when
    a submission could not be graded and a person must look at it.
    """

    lab: Annotated[str, tyro.conf.Positional]
    """such as lab03"""
    submissions: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """a notebook, a folder of notebooks or of students' folders, or learning platforms' zips as
    they are; with them Moodle's grading worksheet (.csv), if students have the same name
    """
    out: Path
    """folder for the records and the gradebook"""
    workers: int = 2
    """submissions at a time"""
    cluster: str = ""
    """address of a scheduler of `distributed` whose workers grade instead, such as
    tcp://10.0.0.5:8786
    """
    resume: bool = False
    """continue an earlier run: records that exist are kept"""
    regrade: bool = False
    """grade recorded submissions again, on the same cases, and report changes"""
    salt: str = ""
    """the course's secret that `labs release` was given"""
    course: Path | None = None
    """the course's folder that `labs release` was given: the secret in salt.txt, who is in the
    course in roster.csv, deadlines in course.toml
    """
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    unsafe_no_sandbox: bool = False
    """run students' code in plain processes with all of your permissions; noted in every record"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Grade the submissions, write records and gradebook.

        Returns:
            0 if every submission was graded or is unreadable, 1 if a person must look at one.

        Raises:
            InputError: a folder, lab or option cannot be used, or the sandbox has a hole.
        """
        from falconwing_kit.tools.grading.find import lab_folder, load_checks
        from falconwing_kit.tools.grading.judge import Assignment
        from falconwing_kit.tools.grading.records import (
            last_records,
            open_run,
            read_grade_records,
            write_points_table,
        )
        from falconwing_kit.tools.grading.roster import (
            collect_hand_ins,
            course_roster,
            hand_in_facts,
        )
        from falconwing_kit.tools.grading.rules import read_rules
        from falconwing_kit.tools.grading.salt import course_key
        from falconwing_kit.tools.grading.sandbox.limits import sweep

        require_range("--workers", self.workers, low=1, high=256)
        folder = lab_folder(self.lab, self.labs).resolve()
        lab = load_checks(folder)
        key = course_key(self.salt, self.course)
        roster = course_roster(self.course)
        deadline = read_rules(self.course).lab(lab.name).deadline
        handed_in = collect_hand_ins(self.submissions, lab.name, roster)
        facts = {
            each.student: hand_in_facts(each, roster, deadline) for each in handed_in.submissions
        }
        sandboxed = not self.unsafe_no_sandbox
        if sandboxed and self.cluster:
            _require_worker_sandboxes(self.cluster)
        elif sandboxed:
            _require_sandbox()
        secret = open_run(
            self.out, lab.name, key, sandboxed=sandboxed, go_on=self.resume or self.regrade
        )
        known = last_records(read_grade_records(self.out))
        sweep()
        try:
            assignment = Assignment(folder, key, secret, sandboxed)
            counts = self._grade(assignment, lab, handed_in, known, facts)
        finally:
            sweep()
            records = last_records(read_grade_records(self.out))
            book = write_points_table(
                self.out, [exercise.name for exercise in lab.exercises], records.values()
            )
        size = None if roster is None else len(roster)
        counts |= {"gradebook": str(book), "roster": size, "passed_over": handed_in.passed_over}
        return self._report(lab, list(records.values()), counts)

    def _grade(
        self,
        assignment: "Assignment",
        lab: "Lab",
        handed_in: "HandIns",
        known: Records,
        facts: Records,
    ) -> dict[str, Any]:
        """Grade what has no valid record yet, append each record immediately, and count."""
        from tqdm import tqdm

        from falconwing_kit.tools.grading.judge import (
            GradingTask,
            error_record,
            grade_submission,
            missing_record,
        )
        from falconwing_kit.tools.grading.records import append_record
        from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map

        found = handed_in.submissions
        todo, before = [], {each.student: known.get(each.student, {}) for each in found}
        for each in found:
            same = (
                each.sha256 != ""
                and before[each.student].get("sha256") == each.sha256
                and before[each.student].get("status") != "error"
            )
            moved = same and any(
                before[each.student].get(k) != v for k, v in facts[each.student].items()
            )
            if moved and not self.regrade:  # such as a new deadline: no need to grade again
                append_record(self.out, before[each.student] | facts[each.student])
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
            result = result | facts[work.submission.student]
            if result != before[work.submission.student]:
                append_record(self.out, result)
                changed += 1
        for student in handed_in.missing:
            if known.get(student, {}).get("status", "missing") == "missing":
                nothing = missing_record(student, assignment, lab)
                if known.get(student) != nothing:
                    append_record(self.out, nothing)
        gone = len(set(known) - set(before) - set(handed_in.missing))
        return {
            "graded_now": len(todo),
            "left": len(found) - len(todo),
            "changed": changed,
            "not_found": gone,
        }

    def _report(self, lab: "Lab", records: list[dict[str, Any]], counts: dict[str, Any]) -> int:
        """Print the results; 1 if a person must look at a submission."""
        from falconwing_kit.tools.grading.judge import STATES, record_state

        failed = [record for record in records if record["status"] == "error"]
        states = [record_state(record) for record in records if record.get("known", True)]
        strangers = [record for record in records if not record.get("known", True)]
        by_state = {state: states.count(state) for state in STATES}
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
            means = {name: mean for name, _, mean, _ in rows}
            print_json(
                {
                    "lab": lab.name,
                    "sandboxed": not self.unsafe_no_sandbox,
                    **by_state,
                    "strangers": len(strangers),
                    **counts,
                    "mean": means,
                }
            )
            return int(bool(failed))
        title = (
            f"{lab.name}: {len(marked)} of {len(records)} submissions graded, "
            f"{counts['graded_now']} of them now"
        )
        total = " + ".join(f"{count} {state}" for state, count in by_state.items() if count)
        print_table(("exercise", "points", "mean", "all cases passed"), rows, title=title)
        print(
            f"{len(states)} students = {total or 0}"
            + (f"; {len(strangers)} not on the roster" if strangers else "")
        )
        size = counts["roster"]
        if size is not None and len(states) != size:
            gone = f"{len(states)} students for a roster of {size}"
            print(f"! {gone}: the roster has changed; grade into a new --out")
        for name in counts["passed_over"]:
            print(f"! {name}: not a notebook, and nobody's; passed over")
        if self.regrade:
            print(f"regraded {counts['graded_now']}; {counts['changed']} differ from their record")
        for record in records:
            if record_state(record) != "graded" or record["problem"]:
                said = record["problem"] or _late_text(record)
                print(f"! {record['student']}: {record_state(record)}: {said}")
        if self.unsafe_no_sandbox:
            print("! graded without a sandbox: these points can be forged")
        next_line(f"open {counts['gradebook']}; it lacks the points by a person (figures, answers)")
        return int(bool(failed))


def _late_text(record: dict[str, Any]) -> str:
    days = record.get("late_days")
    return "by an unknown time" if days is None else f"by {days} begun days"


def _require_sandbox() -> None:
    """Raise InputError if the sandbox has a hole."""
    from falconwing_kit.tools.grading.sandbox.probe import open_holes, probe_sandbox

    _refuse_holes(open_holes(probe_sandbox()))


def _require_worker_sandboxes(cluster: str) -> None:
    """Raise InputError if the sandbox of any worker of a cluster has a hole."""
    from falconwing_kit.tools.grading.sandbox.probe import open_holes, probe_sandbox
    from falconwing_kit.tools.jobs.cluster import run_on_every_worker

    tried = run_on_every_worker(probe_sandbox, cluster)
    _refuse_holes(
        [f"{worker}: {hole}" for worker, findings in tried.items() for hole in open_holes(findings)]
    )


def _refuse_holes(found: Sequence[str]) -> None:
    if found:
        raise InputError(
            f"sandbox: expected it closed, got {len(found)} holes ({'; '.join(found)}); fix them "
            "(`falconwing sandbox probe` lists them), or accept forged points with "
            "--unsafe-no-sandbox"
        )
