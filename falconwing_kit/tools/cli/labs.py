"""falconwing labs: build the labs' notebooks, release and test them, collect a student's parts."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.tools.grading.find import select_labs


@dataclass(frozen=True)
class Build:
    """Write the notebooks of the labs from their sources.

    Exit code 0 if they are written, or none is stale; else 1.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """labs, such as lab03; all if none is named"""
    check: bool = False
    """write nothing, list the stale notebooks"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Build, or list stale notebooks.

        Returns:
            0 if the notebooks match their sources; 1 if `check` found stale ones.

        Raises:
            InputError: there is no such lab, or its source cannot be used.
        """
        from falconwing_kit.tools.grading.notebooks import stale_notebooks, write_notebooks

        process = stale_notebooks if self.check else write_notebooks
        changed = {folder.name: process(folder) for folder in select_labs(self.names, self.labs)}
        word, stale = ("stale", sum(map(len, changed.values()))) if self.check else ("written", 0)
        if self.json:
            print_json(
                {name: [short_name(path) for path in paths] for name, paths in changed.items()}
            )
            return int(stale > 0)
        rows = [(name, ", ".join(map(short_name, paths)) or "-") for name, paths in changed.items()]
        print_table(("lab", word), rows, title=f"{stale} stale notebooks" if self.check else "")
        next_line("falconwing labs build" if stale else "falconwing labs selftest")
        return int(stale > 0)


@dataclass(frozen=True)
class Hints:
    """Store what the listed mistakes of each lab return in its public checks, in hints.json.

    In a checkout: the lists are in tests/labs/mutants. Exit code 0 if the files are written.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """labs, such as lab03; all if none is named"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Write the files.

        Returns:
            0: they are written; a lab without a list gets none.

        Raises:
            InputError: there is no such lab, or its source cannot be used.
        """
        from falconwing_kit.core.files import atomic_write
        from falconwing_kit.tools.grading.hints import FILE
        from falconwing_kit.tools.grading.hints_library import hints_texts

        folders, sizes = select_labs(self.names, self.labs), {}
        for folder, text in zip(folders, hints_texts(folders), strict=True):
            sizes[folder.name] = len(text.encode())
            if text:
                with atomic_write(folder / FILE, text=True) as handle:
                    handle.write(text)
        if self.json:
            print_json(sizes)
            return 0
        print_table(("lab", "bytes"), list(sizes.items()))
        next_line("falconwing labs selftest")
        return 0


@dataclass(frozen=True)
class Release:
    """Write the students' folder, without solutions, hidden cases and notes."""

    out: Annotated[Path, tyro.conf.Positional]
    """a new folder"""
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """labs, such as lab03; all if none is named"""
    salt: str = ""
    """your course's secret, the seed of its numbers, if you type one; `grade` needs the same"""
    course: Path | None = None
    """your course's folder: its salt.txt is the secret, made by the kit on the first release.
    Without --course and --salt: the open course
    """
    roster: Path | None = None
    """CSV file of the students, yours or a platform's, for labs with numbers per student; needs a
    secret. Without it: roster.csv in --course
    """
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Write the folder.

        Returns:
            0: it is written.

        Raises:
            FileNotFoundError: there is no roster.
            InputError: the folder is not empty, the roster cannot be used, or a lab cannot.
        """
        from falconwing_kit.tools.grading.release import release
        from falconwing_kit.tools.grading.roster import course_roster, read_roster
        from falconwing_kit.tools.grading.salt import SALT_FILE, course_key

        folders = select_labs(self.names, self.labs)
        roster = read_roster(self.roster) if self.roster else course_roster(self.course)
        students = [each.id for each in roster or ()]
        key = course_key(self.salt, self.course, make=True)
        files = release(folders, self.out, key, students)
        counts = {
            folder.name: sum(folder.name in path.parts for path in files) for folder in folders
        }
        if self.json:
            print_json(
                {
                    "out": str(self.out),
                    "salted": bool(key),
                    "students": len(students),
                    "files": counts,
                }
            )
            return 0
        course = "your course's numbers" if key else "the open course"
        print_table(
            ("lab", "files"),
            list(counts.items()),
            title=f"{self.out}: {course}, {len(students)} students",
        )
        if key:
            name = "the salt" if self.course is None else str(self.course / SALT_FILE)
            print(f"keep {name}, and keep it secret: grading these labs needs it")
        if students:
            print("handouts has one folder per student; give it to that student only")
        next_line("hand the folder out; later falconwing grade lab01 SUBMISSIONS --out grades")
        return 0


@dataclass(frozen=True)
class Web:
    """Build a static site where students do labs in the browser, and install nothing.

    Labs 1, 2, 4, 5, 7, 11 and 12. Needs the extra `web` and an unpacked Pyodide distribution.
    """

    out: Annotated[Path, tyro.conf.Positional]
    """a new folder"""
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """labs, such as lab01; all that run in a browser if none is named"""
    pyodide: Path | None = None
    """the folder of a Pyodide distribution: the browser's Python, which the kit does not ship"""
    salt: str = ""
    """the course's secret, if you type one"""
    course: Path | None = None
    """the course's folder, with salt.txt; without --course and --salt: the open course"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""

    def run(self) -> int:
        """Build the site.

        Returns:
            0: it is built.

        Raises:
            InputError: a lab does not run in a browser, or the Pyodide folder cannot be used.
        """
        from falconwing_kit.tools.grading.hosted import IN_BROWSER
        from falconwing_kit.tools.grading.salt import course_key
        from falconwing_kit.tools.grading.web import web_site

        key = course_key(self.salt, self.course, make=True)
        folders = select_labs(self.names or IN_BROWSER, self.labs)
        count = web_site(folders, self.out, self.pyodide, key)
        size = sum(path.stat().st_size for path in self.out.rglob("*") if path.is_file())
        print(f"{self.out}: {len(folders)} labs, {count} files, {size / 1e6:.0f} MB")
        if key:
            print("keep your course's salt: grading these labs needs it")
        next_line(f"python -m http.server --directory {self.out}, and open lab/index.html there")
        return 0


@dataclass(frozen=True)
class Hosted:
    """Write one notebook a lab for a hosted Python, with the lab's files inside, and the kit.

    Labs 3, 6, 8, 9, 10 and 13, which need more than a browser has; others if you name them.
    """

    out: Annotated[Path, tyro.conf.Positional]
    """a new folder"""
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """labs, such as lab03"""
    repository: str | None = None
    """where the first cell installs the kit from; repository_url of manual/settings.toml if not
    given. Without any, students upload the wheel beside the notebook
    """
    salt: str = ""
    """the course's secret, if you type one"""
    course: Path | None = None
    """the course's folder, with salt.txt; without --course and --salt: the open course"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""

    def run(self) -> int:
        """Write the notebooks and the wheel.

        Returns:
            0: they are written.

        Raises:
            InputError: the folder is not empty, the address is not one, or a lab cannot be used.
        """
        from falconwing_kit.tools.grading.hosted import (
            IN_BROWSER,
            hosted_notebooks,
            published_repository,
        )
        from falconwing_kit.tools.grading.salt import course_key

        key = course_key(self.salt, self.course, make=True)
        repository = published_repository() if self.repository is None else self.repository
        folders = select_labs(self.names, self.labs)
        if not self.names:
            folders = [each for each in folders if each.name.split("_")[0] not in IN_BROWSER]
        files = hosted_notebooks(folders, self.out, key, repository)
        print_table(("file", "kB"), [(each.name, each.stat().st_size // 1000) for each in files])
        source = repository or "the wheel, which students upload beside the notebook"
        print(f"the first cell installs the kit from {source}")
        if key:
            print("keep your course's salt: grading these labs needs it")
        next_line("hand the notebooks out; later falconwing grade lab03 SUBMISSIONS --out grades")
        return 0


@dataclass(frozen=True)
class Selftest:
    """Grade the labs' own notebooks: solutions must get full marks, untouched ones none.

    Exit code 0 if they do, else 1.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """labs, such as lab03; all if none is named"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    unsafe_no_sandbox: bool = False
    """run the functions in plain processes; they are the labs' own code"""
    outputs: Path | None = None
    """run the solutions' notebooks too, and write their outputs here for `manual/build.py site`"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Grade and print the results.

        Returns:
            0 if every lab is graded as expected, else 1.

        Raises:
            InputError: there is no such lab, it cannot be used, or there is no sandbox here.
        """
        from falconwing_kit.tools.grading.outputs import write_outputs
        from falconwing_kit.tools.grading.selftest import selftest

        folders = select_labs(self.names, self.labs)
        if self.outputs is not None:
            for folder in folders:
                write_outputs(folder.resolve(), self.outputs)
        results = [selftest(folder, sandboxed=not self.unsafe_no_sandbox) for folder in folders]
        passed = all(result.passed for result in results)
        if self.json:
            print_json({"passed": passed, "labs": [asdict(result) for result in results]})
            return int(not passed)
        rows = [
            (r.lab, _percent(r.solution, r.of), _percent(r.untouched, r.of), r.passed)
            for r in results
        ]
        print_table(
            ("lab", "solution", "untouched", "as expected"),
            rows,
            title="points by automatic grading",
        )
        for sentence in (
            f"! {result.lab}: {problem}" for result in results for problem in result.problems
        ):
            print(sentence)
        next_line(
            "falconwing labs release OUT"
            if passed
            else "fix the labs that are not graded as expected"
        )
        return int(not passed)


def _percent(points: Mapping[str, float], of: Mapping[str, float]) -> str:
    return f"{100.0 * sum(points.values()) / sum(of.values()):.1f} %"


@dataclass(frozen=True)
class Autograder:
    """Write the zip with which Gradescope grades a lab's functions by itself."""

    out: Annotated[Path, tyro.conf.Positional]
    """the zip"""
    lab: Annotated[str, tyro.conf.Positional]
    """such as lab03"""
    salt: str = ""
    """the course's secret, if you type one"""
    course: Path | None = None
    """the course's folder, with salt.txt and roster.csv"""
    unsafe_no_sandbox: bool = False
    """grade where Gradescope's container allows no sandbox; points can then be forged"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""

    def run(self) -> int:
        """Write the zip.

        Returns:
            0: it is written.

        Raises:
            InputError: there is no such lab, or the secret cannot be used.
        """
        from falconwing_kit.tools.grading.course.autograder import write_autograder
        from falconwing_kit.tools.grading.find import lab_folder
        from falconwing_kit.tools.grading.salt import course_key

        folder = lab_folder(self.lab, self.labs).resolve()
        key = course_key(self.salt, self.course)
        write_autograder(self.out, folder, key, self.course, sandboxed=not self.unsafe_no_sandbox)
        print(f"{self.out}: {self.out.stat().st_size >> 20} MiB; it holds the hidden cases and the")
        print("course's key, so give it to Gradescope only")
        next_line("upload it as the assignment's autograder, Ubuntu 24.04 or newer")
        return 0


@dataclass(frozen=True)
class Gradebook:
    """Write the course's gradebook from the labs' reports: late days, dropped labs, weights.

    Exit code 1 if a lab has no record of a student of the roster.
    """

    out: Annotated[Path, tyro.conf.Positional]
    """folder for course.csv and course_canvas.csv"""
    reports: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """the folders that `report --out` wrote, a lab each"""
    course: Path | None = None
    """the course's folder, with roster.csv and course.toml"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Write and print the gradebook.

        Returns:
            0 if every student has a record in every lab, else 1.

        Raises:
            InputError: a folder has no report, or two have the same lab's.
        """
        from falconwing_kit.tools.grading.course.course_gradebook import (
            course_results,
            read_totals,
            write_course,
        )
        from falconwing_kit.tools.grading.roster import course_roster
        from falconwing_kit.tools.grading.rules import read_rules

        labs = [read_totals(report) for report in self.reports]
        names = [name for name, _ in labs]
        if not names or len(set(names)) < len(names):
            got = ", ".join(names) or "none"
            raise InputError(f"reports: expected one of each lab, got {got}; name each once")
        roster = course_roster(self.course)
        ids = None if roster is None else [student.id for student in roster]
        results = course_results(dict(sorted(labs)), read_rules(self.course), ids)
        self.out.mkdir(parents=True, exist_ok=True)
        write_course(self.out, results, roster or ())
        final = [each.percent for each in results if each.percent is not None]
        states = {
            name: Counter(each.labs[name].state for each in results) for name in sorted(names)
        }
        lost = sum(count["no record"] for count in states.values())
        if self.json:
            print_json({"students": len(results), "final": len(final), "labs": states})
            return int(lost > 0)
        rows = [
            (name, sum(count.values()), " + ".join(f"{n} {s}" for s, n in sorted(count.items())))
            for name, count in states.items()
        ]
        mean = f", {sum(final) / len(final):.1f} % on average" if final else ""
        title = f"{len(results)} students, {len(final)} with a final result{mean}"
        print_table(("lab", "students", "of them"), rows, title=title)
        next_line(f"open {self.out / 'course.csv'}")
        return int(lost > 0)


@dataclass(frozen=True)
class CollectMine:
    """Build the package my_falconwing of the functions that you wrote.

    A function that is missing or fails its public checks is the kit's; the table has the reason.
    """

    folder: Annotated[Path | None, tyro.conf.Positional] = None
    """the folder with your labs; the current folder's, or the checkout's own, if not given"""
    out: Path = Path("my_falconwing")
    """the package's folder; an older one that this verb wrote is replaced"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Check the notebooks and write the package.

        Returns:
            0: it is written.

        Raises:
            InputError: there is no lab in the folder, or `out` holds something else.
        """
        from falconwing_kit.tools.grading.find import lab_folders, labs_folder
        from falconwing_kit.tools.grading.mine import PARTS, collect_mine
        from falconwing_kit.tools.grading.public_checks import to_printable

        if self.folder is not None and not lab_folders(self.folder):
            raise InputError(
                f"{self.folder}: expected a folder with your labs, such as lab01_sizing in it, "
                "found none; name the folder that holds them"
            )
        choices = collect_mine(labs_folder(self.folder), self.out)
        if self.json:
            print_json({"out": str(self.out), "functions": list(map(asdict, choices))})
            return 0
        rows = []
        for part in PARTS:
            ours = [each for each in choices if each.part == part.module]
            mine = [each.function for each in ours if each.mine]
            kit = [each.function for each in ours if not each.mine]
            rows.append((part.module, part.lab, ", ".join(mine) or "-", ", ".join(kit) or "-"))
        count = sum(each.mine for each in choices)
        title = f"{self.out}: {count} of {len(choices)} functions are yours"
        print_table(("part", "lab", "yours", "the kit's"), rows, title=title)
        for each in choices:
            if not each.mine and each.why not in ("not written", "no folder of this lab"):
                print(to_printable(f"! {each.part}.{each.function}: {each.why}"))
        next_line('open lab13_fly_your_own, and set PARTS = "mine" in its first cell')
        return 0


@dataclass(frozen=True)
class Board:
    """Rank lab 13's entries: their commands are flown again in the grading sandbox."""

    entries: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """the entries, JSON, a file each; its name stands on the board"""
    salt: str = ""
    """the course's secret, if you type one"""
    course: Path | None = None
    """the course's folder, with salt.txt"""
    unsafe_no_sandbox: bool = False
    """fly in plain processes; an entry holds numbers only"""
    labs: Path | None = None
    """the folder with the labs; the checkout's own if not given"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Fly and print the board.

        Returns:
            0 if every entry was flown, else 1.

        Raises:
            FileNotFoundError: an entry is missing.
            InputError: no entry is named, or there is no sandbox here.
        """
        from falconwing_kit.tools.grading.course.board import rank_entries
        from falconwing_kit.tools.grading.salt import course_key

        if not self.entries:
            raise InputError("entries: expected one file or more, got none; name them")
        key = course_key(self.salt, self.course)
        board = rank_entries(self.entries, key, self.labs, sandboxed=not self.unsafe_no_sandbox)
        lost = any(each.problem for each in board)
        if self.json:
            print_json({"board": list(map(asdict, board))})
            return int(lost)
        rows = [
            (place, each.name, each.points, each.claimed, f"{each.mine} of {each.of}")
            for place, each in enumerate(board, 1)
        ]
        print_table(("place", "entry", "points", "claimed", "own functions"), rows)
        for each in board:
            if each.problem:
                print(f"! {each.problem}")
        next_line("points count as flown here, whatever was claimed")
        return int(lost)


@dataclass(frozen=True)
class Labs:
    """Build the labs' notebooks, release them to students, test them, or sum up a course."""

    step: tyro.conf.OmitSubcommandPrefixes[
        Build
        | Hints
        | Release
        | Web
        | Hosted
        | Selftest
        | Autograder
        | Gradebook
        | CollectMine
        | Board
    ]

    def run(self) -> int:
        """Run the chosen step."""
        return self.step.run()
