"""falconwing report: gradebook, feedback, statistics and rubric of a class."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.tools.grading.course.gradebook import GradebookEntry
    from falconwing_kit.tools.grading.course.items import ItemStatistics
    from falconwing_kit.tools.grading.course.similar import Similarity
    from falconwing_kit.tools.grading.lab import Lab

Inspections = dict[str, dict[str, Any]]  # by student, results of `inspect_submission`


@dataclass(frozen=True)
class Report:
    """Report on a graded lab: gradebook.csv, a feedback page per student, report.html for you.

    With --submissions also the public checks' outcomes in the feedback, pairs of similar functions,
    and rubric.html, where you grade figures and answers; --rubric merges the points saved there.
    """

    lab: Annotated[str, tyro.conf.Positional]
    """such as lab03"""
    grades: Annotated[Path, tyro.conf.Positional]
    """the folder that `grade --out` wrote"""
    out: Path
    """folder for the report; the same folder continues an interrupted report"""
    submissions: tuple[Path, ...] = ()
    """what `grade` was given: the notebook, folder, or learning platforms' zips"""
    before: Path | None = None
    """an earlier class's submissions, for the similarity check"""
    rubric: Path | None = None
    """points by a person: points.csv of the rubric page"""
    to: tuple[Literal["moodle", "canvas", "gradescope", "csv"], ...] = ()
    """moodle: a grading worksheet, and a zip with everyone's feedback page; canvas: its gradebook
    for this lab; gradescope: a results.json for each student; csv: final points
    """
    figures: Literal["run", "stored"] = "run"
    """run: run the notebooks in the sandbox; stored: show the figures stored in them"""
    workers: int = 2
    """submissions at a time"""
    cluster: str = ""
    """address of a scheduler of `distributed` whose workers inspect submissions instead"""
    salt: str = ""
    """the course's secret that `grade` was given"""
    course: Path | None = None
    """the course's folder that `grade` was given, with the secret in salt.txt"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Write the report.

        Returns:
            0: it is written.

        Raises:
            FileNotFoundError: there is no file at --rubric.
            InputError: the records, the submissions or the points cannot be used.
        """
        from falconwing_kit.tools.grading.course.course_gradebook import TOTALS, write_totals
        from falconwing_kit.tools.grading.course.gradebook import (
            make_entries,
            read_rubric,
            write_gradebook,
        )
        from falconwing_kit.tools.grading.course.items import item_statistics
        from falconwing_kit.tools.grading.find import lab_folder, load_checks
        from falconwing_kit.tools.grading.quiz import SOURCE
        from falconwing_kit.tools.grading.records import (
            last_records,
            read_grade_records,
            require_run,
        )
        from falconwing_kit.tools.grading.rules import read_rules

        require_range("--workers", self.workers, low=1, high=256)
        folder = lab_folder(self.lab, self.labs).resolve()
        lab = load_checks(folder)
        require_run(self.grades, lab.name, self._key())
        records = last_records(read_grade_records(self.grades))
        if not records:
            raise InputError(
                f"{self.grades}: expected at least one record, found none; grade first"
            )
        points = read_rubric(self.rubric, lab, records) if self.rubric else {}
        quiz = read_rules(self.course).quiz_points if (folder / SOURCE).is_file() else 0.0
        entries = make_entries(lab, records, points, quiz)
        self.out.mkdir(parents=True, exist_ok=True)
        inspections, notes = self._inspect(folder, entries) if self.submissions else ({}, [])
        write_gradebook(self.out / "gradebook.csv", lab, entries)
        write_totals(self.out / TOTALS, lab.name, entries)
        items = item_statistics(lab, list(records.values()))
        pairs = self._pages(folder, lab, entries, items, inspections)
        self._exports(lab, entries)
        return self._print(lab, entries, items, pairs, notes)

    def _key(self) -> str:
        """The course's key."""
        from falconwing_kit.tools.grading.salt import course_key

        return course_key(self.salt, self.course)

    def _inspect(
        self, folder: Path, entries: "Sequence[GradebookEntry]"
    ) -> tuple[Inspections, list[str]]:
        """Inspect the graded submissions; the notes list those that could not be inspected."""
        from tqdm import tqdm

        from falconwing_kit.tools.grading.course.looks import (
            InspectionTask,
            ReportContext,
            empty_inspection,
            inspect_submission,
            lab_fingerprint,
        )
        from falconwing_kit.tools.grading.roster import collect_hand_ins, course_roster
        from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map

        why = self._sandbox_problem()
        notes = [f"{why}: public checks were not run, and figures are as stored"] if why else []
        places = [place.resolve() for place in self.submissions]
        roster = course_roster(self.course)
        handed_in = collect_hand_ins(places, entries[0].lab.name, roster)
        found = {each.student: each for each in handed_in.submissions}
        tasks = []
        for entry in entries:
            submission, record = found.get(entry.student), entry.record
            if record["status"] == "missing":
                continue
            if submission is None or submission.sha256 != record["sha256"]:
                problem = "not found" if submission is None else "changed since it was graded"
                notes.append(f"{entry.student}: {problem}")
                continue
            lost = [
                name for name, each in record["exercises"].items() if each["right"] < each["cases"]
            ]
            tasks.append(InspectionTask(submission, tuple(lost)))
        inspect = partial(
            inspect_submission,
            context=ReportContext(
                folder, self._key(), not why, self.figures == "run", lab_fingerprint(folder)
            ),
        )
        done = parallel_map(inspect, tasks, self.workers, self.cluster, self.out / "looks")
        inspections = {}
        for task, result in tqdm(
            done, total=len(tasks), desc=entries[0].lab.name, unit="submission", disable=None
        ):
            if isinstance(result, WorkerLostError):
                result = empty_inspection("could not be inspected")
            inspections[task.submission.student] = result
        return inspections, notes

    def _sandbox_problem(self) -> str:
        """Why students' code may not be run; empty if the sandbox has no hole."""
        from falconwing_kit.tools.grading.sandbox.probe import open_holes, probe_sandbox
        from falconwing_kit.tools.jobs.cluster import run_on_every_worker

        try:
            tried = (
                list(run_on_every_worker(probe_sandbox, self.cluster).values())
                if self.cluster
                else [probe_sandbox()]
            )
        except InputError as error:
            return str(error)
        return "; ".join(hole for findings in tried for hole in open_holes(findings))

    def _pages(
        self,
        folder: Path,
        lab: "Lab",
        entries: "Sequence[GradebookEntry]",
        items: "Sequence[ItemStatistics]",
        inspections: Inspections,
    ) -> "list[Similarity] | None":
        """Write the pages for students, for manual grading and for the instructor."""
        from falconwing_kit.tools.grading.course.feedback import write_feedback
        from falconwing_kit.tools.grading.course.looks import rubric_parts
        from falconwing_kit.tools.grading.course.overview import write_overview
        from falconwing_kit.tools.grading.course.rubric import write_rubric

        (self.out / "feedback").mkdir(exist_ok=True)
        for entry in entries:
            checks = inspections.get(entry.student, {}).get("checks") or None
            write_feedback(self.out / "feedback" / f"{entry.file_name}.html", entry, checks)
        pairs, texts = self._find_similar(folder, lab, inspections) if inspections else (None, {})
        write_overview(self.out / "report.html", lab, entries, items, pairs, texts)
        if inspections and lab.rubric:
            write_rubric(self.out, lab, rubric_parts(folder), entries, inspections)
        return pairs

    def _find_similar(
        self, folder: Path, lab: "Lab", inspections: Inspections
    ) -> "tuple[list[Similarity], Mapping[tuple[str, str], str]]":
        """Compare functions within the class, with an earlier class, the kit and the solution."""
        from falconwing_kit.tools.grading.course.gradebook import write_csv
        from falconwing_kit.tools.grading.course.similar import compare_class

        pairs, texts = compare_class(
            folder, lab, {name: one["sources"] for name, one in inspections.items()}, self.before
        )
        head = ("this", "and this", "weight_bit", "functions and share")
        rows = [(each.left, each.right, round(each.weight, 1), each.functions) for each in pairs]
        write_csv(self.out / "alike.csv", head, rows)
        return pairs, texts

    def _exports(self, lab: "Lab", entries: "Sequence[GradebookEntry]") -> None:
        """Write the files for learning platforms."""
        from falconwing_kit.tools.grading.course.exports import write_canvas, write_moodle
        from falconwing_kit.tools.grading.course.feedback import result_text
        from falconwing_kit.tools.grading.course.gradebook import (
            write_gradescope,
            write_platform_csv,
        )
        from falconwing_kit.tools.grading.roster import course_roster
        from falconwing_kit.tools.grading.rules import read_rules

        if "moodle" in self.to:
            write_moodle(self.out, entries, self.out / "feedback")
        if "canvas" in self.to:
            roster = course_roster(self.course)
            if roster is None:
                raise InputError("--to canvas: expected --course with a roster.csv, found none")
            rules = read_rules(self.course).lab(lab.name)
            write_canvas(self.out / "canvas.csv", lab.name, rules, entries, roster)
        if "csv" in self.to:
            write_platform_csv(self.out / "platform.csv", lab, entries)
        if "gradescope" in self.to:
            words = {
                e.student: {n: result_text(r) for n, r in e.record["exercises"].items()}
                for e in entries
            }
            write_gradescope(self.out / "gradescope", entries, words)

    def _print(
        self,
        lab: "Lab",
        entries: "Sequence[GradebookEntry]",
        items: "Sequence[ItemStatistics]",
        pairs: "Sequence[Similarity] | None",
        notes: Sequence[str],
    ) -> int:
        """Print the results."""
        final = sum(entry.total is not None for entry in entries)
        if self.json:
            counts = {
                "students": len(entries),
                "final": final,
                "alike": None if pairs is None else len(pairs),
            }
            stats = [asdict(item) for item in items]
            print_json(
                {"lab": lab.name, "out": str(self.out), **counts, "items": stats, "notes": notes}
            )
            return 0
        rows = [
            (i.name, 100.0 * i.mean, 100.0 * i.untouched, i.discrimination, i.commonest or "-")
            for i in items
        ]
        head = ("exercise", "mean [%]", "untouched [%]", "discrimination", "commonest loss")
        print_table(
            head,
            rows,
            title=f"{lab.name}: {len(entries)} students, {final} with their final points",
        )
        for note in notes:
            print(f"! {note}")
        if pairs is not None:
            print(
                f"{len(pairs)} pairs of similar functions; read them in {self.out / 'report.html'}"
            )
        if final == len(entries):
            next_line(
                f"hand out {self.out / 'feedback'}; the points are in {self.out / 'gradebook.csv'}"
            )
        elif self.submissions:
            next_line(
                f"grade figures and answers in {self.out / 'rubric.html'}, then --rubric points.csv"
            )
        else:
            next_line("the same with --submissions, to grade figures and answers")
        return 0
