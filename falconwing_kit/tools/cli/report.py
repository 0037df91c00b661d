"""falconwing report: a class's records -> gradebook, feedback, statistics, likeness, rubric page,
exports.
"""

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

Looked = dict[str, dict[str, Any]]  # by student, what `looks.look` gives


@dataclass(frozen=True)
class Report:
    """Report on a graded lab: gradebook.csv, a page of feedback for each student, report.html for
    you.

    With --submissions also the public checks' outcomes in the feedback, functions that are alike,
    and rubric.html, where you grade figures and answers; --rubric merges the points that it saves.
    """

    lab: Annotated[str, tyro.conf.Positional]
    """such as lab03"""
    grades: Annotated[Path, tyro.conf.Positional]
    """the folder that `grade --out` wrote"""
    out: Path
    """folder for the report; saying it again goes on where a killed report was"""
    submissions: Path | None = None
    """what was graded: a notebook, a folder, or a learning platform's zip"""
    before: Path | None = None
    """an earlier class's submissions, to compare functions with"""
    rubric: Path | None = None
    """the points that a person gave: points.csv of the rubric page"""
    to: tuple[Literal["gradescope", "csv"], ...] = ()
    """gradescope: a results.json for each student; csv: final points for a learning platform"""
    figures: Literal["run", "stored"] = "run"
    """run notebooks in the box for their figures, or show those that they have stored"""
    workers: int = 2
    """submissions at a time"""
    cluster: str = ""
    """address of a scheduler of `distributed` whose workers look at submissions instead"""
    salt: str = ""
    """the course's secret that `grade` was given"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Write the report.

        Returns:
            0: it is there.

        Raises:
            FileNotFoundError: there is no file at --rubric.
            InputError: the records, the submissions or the points cannot be used.
        """
        from falconwing_kit.tools.grading.course.gradebook import (
            make_entries,
            read_rubric,
            write_gradebook,
        )
        from falconwing_kit.tools.grading.course.items import item_statistics
        from falconwing_kit.tools.grading.find import lab_folder, load_checks
        from falconwing_kit.tools.grading.records import (
            last_records,
            read_grade_records,
            require_run,
        )

        require_range("--workers", self.workers, low=1, high=256)
        folder = lab_folder(self.lab, self.labs).resolve()
        lab = load_checks(folder)
        require_run(self.grades, lab.name, self.salt)
        records = last_records(read_grade_records(self.grades))
        if not records:
            raise InputError(
                f"{self.grades}: expected at least one record, found none; grade first"
            )
        points = read_rubric(self.rubric, lab, records) if self.rubric else {}
        entries = make_entries(lab, records, points)
        self.out.mkdir(parents=True, exist_ok=True)
        looked, notes = self._look(folder, entries) if self.submissions else ({}, [])
        write_gradebook(self.out / "gradebook.csv", lab, entries)
        items = item_statistics(lab, list(records.values()))
        pairs = self._pages(folder, lab, entries, items, looked)
        self._exports(lab, entries)
        return self._say(lab, entries, items, pairs, notes)

    def _look(self, folder: Path, entries: "Sequence[GradebookEntry]") -> tuple[Looked, list[str]]:
        """Look at the submissions that were graded, and say what could not be looked at."""
        from tqdm import tqdm

        from falconwing_kit.tools.grading.course.looks import (
            InspectionTask,
            ReportContext,
            empty_inspection,
            inspect_submission,
            lab_fingerprint,
        )
        from falconwing_kit.tools.grading.submissions import find_submissions
        from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map

        why = self._sandbox_problem()
        notes = [f"{why}: public checks were not run, and figures are as stored"] if why else []
        found = {
            each.student: each
            for each in find_submissions(Path(str(self.submissions)).resolve(), entries[0].lab.name)
        }
        works = []
        for entry in entries:
            mine, record = found.get(entry.student), entry.record
            if mine is None or mine.sha256 != record["sha256"]:
                notes.append(
                    f"{entry.student}: {'not found' if mine is None else 'changed since it was graded'}"
                )
                continue
            lost = [
                name for name, each in record["exercises"].items() if each["right"] < each["cases"]
            ]
            works.append(InspectionTask(mine, tuple(lost)))
        task = partial(
            inspect_submission,
            context=ReportContext(
                folder, self.salt, not why, self.figures == "run", lab_fingerprint(folder)
            ),
        )
        done = parallel_map(task, works, self.workers, self.cluster, self.out / "looks")
        looked = {}
        for work, seen in tqdm(
            done, total=len(works), desc=entries[0].lab.name, unit="submission", disable=None
        ):
            lost_one = isinstance(seen, WorkerLostError)
            looked[work.submission.student] = (
                empty_inspection("could not be looked at") if lost_one else seen
            )
        return looked, notes

    def _sandbox_problem(self) -> str:
        """Why nothing of a student's may be run; empty where the box holds."""
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
        looked: Looked,
    ) -> "list[Similarity] | None":
        """Write the pages: for students, for whoever grades by hand, for the instructor."""
        from falconwing_kit.tools.grading.course.feedback import write_feedback
        from falconwing_kit.tools.grading.course.looks import rubric_parts
        from falconwing_kit.tools.grading.course.overview import write_overview
        from falconwing_kit.tools.grading.course.rubric import write_rubric

        (self.out / "feedback").mkdir(exist_ok=True)
        for entry in entries:
            checks = looked.get(entry.student, {}).get("checks") or None
            write_feedback(self.out / "feedback" / f"{entry.file_name}.html", entry, checks)
        pairs, texts = self._find_similar(folder, lab, looked) if looked else (None, {})
        write_overview(self.out / "report.html", lab, entries, items, pairs, texts)
        if looked and lab.rubric:
            write_rubric(self.out, lab, rubric_parts(folder), entries, looked)
        return pairs

    def _find_similar(
        self, folder: Path, lab: "Lab", looked: Looked
    ) -> "tuple[list[Similarity], Mapping[tuple[str, str], str]]":
        """Compare the functions of the class with each other, an earlier class, the kit and the
        solution.
        """
        from falconwing_kit.tools.grading.course.gradebook import write_csv
        from falconwing_kit.tools.grading.course.similar import compare_class

        pairs, texts = compare_class(
            folder, lab, {name: seen["sources"] for name, seen in looked.items()}, self.before
        )
        head = ("this", "and this", "weight_bit", "functions and share")
        rows = [(each.left, each.right, round(each.weight, 1), each.functions) for each in pairs]
        write_csv(self.out / "alike.csv", head, rows)
        return pairs, texts

    def _exports(self, lab: "Lab", entries: "Sequence[GradebookEntry]") -> None:
        """What other systems read."""
        from falconwing_kit.tools.grading.course.feedback import result_text
        from falconwing_kit.tools.grading.course.gradebook import (
            write_gradescope,
            write_platform_csv,
        )

        if "csv" in self.to:
            write_platform_csv(self.out / "platform.csv", lab, entries)
        if "gradescope" in self.to:
            words = {
                e.student: {n: result_text(r) for n, r in e.record["exercises"].items()}
                for e in entries
            }
            write_gradescope(self.out / "gradescope", entries, words)

    def _say(
        self,
        lab: "Lab",
        entries: "Sequence[GradebookEntry]",
        items: "Sequence[ItemStatistics]",
        pairs: "Sequence[Similarity] | None",
        notes: Sequence[str],
    ) -> int:
        """Print what came out."""
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
                f"{len(pairs)} pairs wrote alike; {self.out / 'report.html'} shows them, for you to read"
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
