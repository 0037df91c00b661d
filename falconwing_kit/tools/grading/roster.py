"""Roster: a CSV file of the course's students -> who handed in what, on whatever platform.

The file is the one that a platform exports, as it is, or one of your own. Columns, with or without
capitals; a student, a name or an email address is enough:

    student (Username, SIS Login ID, ID number, SID), name (Full name; First name and Last name),
    email (Email address), canvas (ID), group (Groups, Section), extension_days
"""

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.records import read_table
from falconwing_kit.tools.grading.rules import days_late
from falconwing_kit.tools.grading.submissions import Submission, find_hand_ins

ROSTER_FILE = "roster.csv"  # in a course's folder
_IDS = ("student", "username", "sis login id", "id number", "sid", "student id", "sis user id")
_CANVAS = ("canvas", "id")  # Canvas's number
_EMAILS, _GROUPS = ("email", "email address"), ("group", "groups", "section", "sections")
_EXTENSIONS = ("extension_days", "extension days")
_MOODLES_NUMBER = re.compile(r"_\d+$")  # of a student in one assignment; another in the next


@dataclass(frozen=True)
class Student:
    """A student of the course.

    Attributes:
        id: by which the kit calls the student in every lab.
        name: in full; empty if unknown.
        email: empty if unknown.
        others: further logins and numbers of the student.
        canvas: Canvas's number; empty if unknown.
        group: of the course; may be empty.
        extension_days: by which every deadline is later for the student.
    """

    id: str
    name: str = ""
    email: str = ""
    others: tuple[str, ...] = ()
    canvas: str = ""
    group: str = ""
    extension_days: int = 0


def read_roster(path: Path) -> list[Student]:
    """The students of a course, in the file's order.

    Args:
        path: a CSV file, see above; commas, semicolons or tabulators.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is no text in UTF-8, has no column that says who, or a student twice.
    """
    head, rows = read_table(path)
    columns = [name.strip().casefold() for name in head]
    names = {"name", "full name", "first name", *_EMAILS}
    if not {*_IDS, *names} & set(columns):
        raise InputError(
            f"{path}: expected a column that says who, such as student, name or email, got "
            f"{', '.join(columns) or 'nothing'}"
        )
    students = []
    for row in rows:
        student = _student(path, {name.strip().casefold(): text for name, text in row.items()})
        if student is not None:
            students.append(student)
    ids = [each.id for each in students]
    for each in ids:
        if ids.count(each) > 1:
            raise InputError(
                f"{path}: expected every student once, got {each} more often; correct the list, "
                "or add a column student with names of their own"
            )
    return students


def course_roster(folder: Path | None) -> list[Student] | None:
    """The roster in a course's folder; None without a folder or a roster in it."""
    if folder is None or not (folder / ROSTER_FILE).exists():
        return None
    return read_roster(folder / ROSTER_FILE)


def _student(path: Path, cells: Mapping[str, str]) -> Student | None:
    """A row's student; None for an empty row and for those that Canvas adds."""
    cells = dict(cells)
    if "student" in cells and "id" in cells:  # Canvas's gradebook: "Lovelace, Ada"
        last, _, first = cells.pop("student").partition(",")
        if last.strip() in ("Points Possible", "Student") or not cells["id"]:
            return None
        cells["name"] = f"{first.strip()} {last.strip()}".strip()
    ids = [cells[each] for each in _IDS if cells.get(each)]
    email = next((cells[each] for each in _EMAILS if cells.get(each)), "")
    parts = (cells.get(each, "") for each in ("first name", "last name", "surname"))
    name = cells.get("name") or cells.get("full name") or " ".join(filter(None, parts))
    canvas = next((cells[each] for each in _CANVAS if cells.get(each)), "")
    who = next(filter(None, [*ids, email, name, canvas]), "")
    if not who:
        return None
    if any(not letter.isprintable() for letter in who) or len(who) > 200:
        raise InputError(f"{path}: expected a student's name of printable letters, got {who!r}")
    extension = next((cells[each] for each in _EXTENSIONS if cells.get(each)), "0")
    if not re.fullmatch(r"\d{1,3}", extension):
        raise InputError(f"{path}: {who}: expected whole extension days, got {extension!r}")
    group = next((cells[each] for each in _GROUPS if cells.get(each)), "")
    if not name and " " in who:
        name = _MOODLES_NUMBER.sub("", who)
    return Student(who, name, email, tuple(ids), canvas, group, int(extension))


class Matcher:
    """The students of a roster by everything that a platform may call them."""

    def __init__(self, roster: Sequence[Student]) -> None:
        self.students = {each.id: each for each in roster}
        self._exact: dict[str, set[str]] = {}
        self._names: dict[str, set[str]] = {}
        for each in roster:
            for word in {each.id, each.email, *each.others} - {""}:
                self._exact.setdefault(_plain(word), set()).add(each.id)
            if each.canvas:
                self._exact.setdefault(f"canvas:{each.canvas}", set()).add(each.id)
            local = each.email.partition("@")[0]
            for word in filter(None, (each.id, each.name, local)):
                for order in _orders(word):
                    self._names.setdefault(order, set()).add(each.id)

    def find(self, names: Iterable[str], numbers: Iterable[str]) -> set[str]:
        """Ids of the students whom a hand-in may be from: by number or email, else by name.

        Args:
            names: as a platform gives them.
            numbers: email addresses, numbers of the university, "canvas:4711". Moodle's numbers
                differ from lab to lab and are of no use.
        """
        for number in filter(None, numbers):
            if _plain(number) in self._exact:
                return self._exact[_plain(number)]
        for name in filter(None, names):
            if _plain(name) in self._exact:
                return self._exact[_plain(name)]
            # Moodle puts the group's name and a hyphen before a name
            tails = [name, *(name[cut.end() :] for cut in re.finditer("-", name))]
            for tail in tails:
                alike = self._names.get(_letters(tail), set())
                same = {i for i in alike if _plain(self.students[i].name) == _plain(tail)}
                if alike:
                    return same or alike
        return set()


def _plain(text: str) -> str:
    return " ".join(unicodedata.normalize("NFC", text).casefold().split())


def _letters(text: str) -> str:
    """Letters and digits without accents, as Canvas joins them: "lovelaceada"."""
    apart = unicodedata.normalize("NFKD", text.casefold())
    return "".join(letter for letter in apart if letter.isalnum())


def _orders(name: str) -> set[str]:
    """A name with its last words first: "Ada Lovelace", "Lovelace Ada"."""
    words = name.replace(",", " ").split()
    return {_letters(" ".join([*words[n:], *words[:n]])) for n in range(max(len(words), 1))} - {""}


@dataclass(frozen=True)
class HandIns:
    """What a class handed in for a lab.

    Attributes:
        submissions: one for each student who handed in; strangers under their platform's name.
        missing: ids of the roster's students who did not.
        passed_over: files that are no notebooks and belong to nobody.
    """

    submissions: tuple[Submission, ...]
    missing: tuple[str, ...] = ()
    passed_over: tuple[str, ...] = ()


def collect_hand_ins(
    places: Sequence[str | Path], lab: str, roster: Sequence[Student] | None
) -> HandIns:
    """The class's hand-ins in one or several exports.

    Args:
        places: notebooks, folders, zips; a CSV file is Moodle's grading worksheet of the lab, which
            tells students of the same name apart and says who was late.
        lab: its name, "lab03".
        roster: the course's students; None leaves everyone under the platform's name.

    Raises:
        InputError: as `find_hand_ins`, or there is no notebook and no roster.
    """
    if not places:
        raise InputError("submissions: expected a notebook, folder or zip, got none; name them")
    exports = [place for place in places if Path(place).suffix.lower() != ".csv"]
    found = [each for place in exports for each in find_hand_ins(place, lab)]
    for place in places:
        if Path(place).suffix.lower() == ".csv":
            found = _with_worksheet(found, Path(place))
    matcher = Matcher(roster or ())
    of: dict[str, list[Submission]] = {}
    passed_over = []
    for each in found:
        student = _whose(each, matcher) if roster is not None else each
        if each.other and not each.platform and (roster is None or not student.known):
            passed_over.append(each.name)
        else:
            of.setdefault(student.student, []).append(student)
    if not of and roster is None:
        shown = ", ".join(map(str, places))
        raise InputError(f"{shown}: expected notebooks (.ipynb) in it, found none")
    submissions = [_only(of[student]) for student in sorted(of)]
    handed_in = {each.student for each in submissions if each.known}
    missing = tuple(each.id for each in roster or () if each.id not in handed_in)
    return HandIns(tuple(submissions), missing, tuple(passed_over))


def _whose(each: Submission, matcher: Matcher) -> Submission:
    """A hand-in under its student's id, or marked as a stranger's."""
    ids = matcher.find((each.name_given, each.student), (each.email, each.number))
    if len(ids) == 1:
        return replace(each, student=next(iter(ids)))
    if not ids:
        return replace(each, known=False, problem=each.problem or "not on the roster")
    why = f"several students have this name: {', '.join(sorted(ids))[:200]}; give Moodle's grading "
    why += "worksheet too, or add the platform's numbers or email addresses to the roster"
    return replace(each, known=False, disputed=True, problem=why)


def _only(several: list[Submission]) -> Submission:
    """A student's hand-in; of several, none, for a person to decide."""
    if len(several) == 1:
        return several[0]
    names = ", ".join(sorted(f"{each.entry} ({each.platform or 'file'})" for each in several))
    why = f"handed in {len(several)} times: {names[:200]}; leave the one to grade"
    return replace(several[0], disputed=True, when=None, sha256="", problem=why)


def _with_worksheet(found: Iterable[Submission], path: Path) -> list[Submission]:
    """Moodle's hand-ins with what its grading worksheet says of each."""
    rows = {}
    for row in read_table(path)[1]:
        cells = {name.strip().casefold(): text for name, text in row.items()}
        number = re.search(r"\d+$", cells.get("identifier", ""))
        if number:
            rows[number[0]] = cells
    if not rows:
        raise InputError(f"{path}: expected Moodle's grading worksheet, with a column Identifier")
    done = []
    for each in found:
        number = _MOODLES_NUMBER.search(each.entry) if each.platform == "moodle" else None
        cells = rows.get(number[0][1:], {}) if number else {}
        late = each.late or "late" in cells.get("status", "").casefold()
        email = cells.get("email address", "") or each.email
        done.append(
            replace(each, email=email, number=cells.get("id number", ""), late=late)
            if cells
            else each
        )
    return done


def hand_in_facts(
    each: Submission, roster: Sequence[Student] | None, deadline: datetime | None
) -> dict[str, Any]:
    """What a record keeps of a hand-in beside its points.

    Returns:
        `entry` and `platform`, to give feedback back; `known`; `late`; `late_days` beyond the
        student's deadline, 0 in time, None if late by an unknown time.
    """
    extension = {one.id: one.extension_days for one in roster or ()}.get(each.student, 0)
    days = days_late(each.handed_in, deadline, extension)
    late = each.late if days is None else days > 0
    return {
        "entry": each.entry,
        "platform": each.platform,
        "known": each.known,
        "late": late,
        "late_days": days if days is not None else None if late else 0,
    }
