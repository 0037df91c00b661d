"""Grading records: results of a grading run <-> its folder, so that the next run can resume.

records.jsonl   one line per graded submission, append-only; a student's last line counts
run.json        lab, course and the secret from which seeds are derived
gradebook.csv   derived from the records
"""

import csv
import hashlib
import io
import json
import os
import re
import secrets
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write, read_text, write_error

Record = dict[str, Any]
_CELL_END = re.compile(r"(?<=[;\t\r\n])")
_FORMULA_SIGNS = "=+-@\u2212"  # U+2212 is the minus sign, which NFKC keeps
RECORDS, RUN, GRADEBOOK = "records.jsonl", "run.json", "gradebook.csv"


def open_run(out: Path, lab: str, salt: str, *, sandboxed: bool, go_on: bool) -> str:
    """Create a run's folder, or open that of an earlier run.

    Args:
        lab: "lab03".
        salt: the course's key; only its fingerprint is stored.
        sandboxed: whether functions run in a sandbox.
        go_on: whether records may exist already.

    Returns:
        The run's secret.

    Raises:
        InputError: there are records and `go_on` is False, or they are of another lab or course.
    """
    settings = {"lab": lab, "course": salt_fingerprint(salt), "sandboxed": sandboxed}
    file = out / RUN
    if (out / RECORDS).exists() and not go_on:
        raise InputError(
            f"{out}: expected a new folder, found records; use --resume, --regrade or another --out"
        )
    if not file.exists():
        out.mkdir(parents=True, exist_ok=True)
        with atomic_write(file, text=True) as handle:
            os.chmod(handle.fileno(), 0o600)
            handle.write(json.dumps(settings | {"secret": secrets.token_hex(16)}, indent=1) + "\n")
    try:
        run: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        secret = str(run.pop("secret"))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(
            f"{file}: expected an earlier run's settings, got something else; choose another --out"
        ) from None
    if run != settings:
        changed = ", ".join(name for name in settings if run.get(name) != settings[name])
        raise InputError(
            f"{out}: expected the lab, salt and sandbox of its earlier run, got another {changed}"
        )
    return secret


def require_run(out: Path, lab: str, salt: str) -> None:
    """Raise InputError unless a folder holds records of this lab in this course.

    Raises:
        InputError: there are none, or the lab or the salt is another.
    """
    try:
        run = json.loads((out / RUN).read_text(encoding="utf-8"))
        found = run["lab"], run["course"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            f"{out}: expected the folder that `grade --out` wrote, found no run in it"
        ) from None
    if found[0] != lab:
        raise InputError(f"{out}: expected records of {lab}, found those of {found[0]}")
    if found[1] != salt_fingerprint(salt):
        raise InputError(
            f"{out}: expected the --course or --salt that this lab was graded with, got another "
            "one or none"
        )


def salt_fingerprint(salt: str) -> str:
    """The stored fingerprint of a course's salt."""
    return hashlib.sha256(salt.encode()).hexdigest()[:16]


def read_grade_records(out: Path) -> list[Record]:
    """All records of a folder, in order; incomplete lines are skipped."""
    file = out / RECORDS
    records = []
    for line in file.read_bytes().split(b"\n") if file.exists() else ():
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict) and "student" in record:
            records.append(record)
    return records


def last_records(records: Iterable[Record]) -> dict[str, Record]:
    """Each student's last record, by student."""
    last = {record["student"]: record for record in records}
    return {student: last[student] for student in sorted(last)}


def append_record(out: Path, record: Mapping[str, Any]) -> None:
    """Append a record and sync it to disk.

    Raises:
        InputError: the disk is full, or the folder may not be written.
    """
    file = out / RECORDS
    line = json.dumps(record, allow_nan=False).encode("ascii") + b"\n"
    try:
        with file.open("a+b") as handle:
            size = handle.seek(0, os.SEEK_END)
            if size and (handle.seek(size - 1), handle.read(1))[1] != b"\n":
                line = b"\n" + line  # after an incomplete line of a killed run
            handle.write(line)
            handle.flush()
            os.fsync(handle.fileno())
    except OSError as error:
        raise write_error(file, error) from None


def write_points_table(out: Path, exercises: Sequence[str], records: Iterable[Record]) -> Path:
    """Write the gradebook of automatic points.

    Args:
        exercises: names, in the lab's order.
        records: in any order; each student's last one counts.

    Returns:
        Its path.
    """
    records = list(records)
    quiz = ["quiz"] if any("quiz" in record for record in records) else []
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["student", *exercises, *quiz, "points", "of", "status", "note", "sandboxed"])
    for student, record in last_records(records).items():
        done = record["exercises"]
        points = [done[name]["points"] if name in done else "" for name in exercises]
        points += [record["quiz"]["right"] if "quiz" in record else ""] if quiz else []
        ends = ("points", "of", "status", "problem", "sandboxed")
        writer.writerow(
            [
                spreadsheet_cell(value)
                for value in (student, *points, *(record[each] for each in ends))
            ]
        )
    with atomic_write(out / GRADEBOOK, text=True) as handle:
        handle.write(table.getvalue())
    return out / GRADEBOOK


def read_table(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a CSV file with commas, semicolons or tabulators.

    Returns:
        The columns as they are, and for each row its cells without surrounding blanks; missing
        cells are empty.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is no text in UTF-8, or no table.
    """
    text = read_text(path)
    head = text.lstrip().split("\n")[0]
    delimiter = max(",;\t", key=head.count)
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
        lines = [line for line in reader if line]
    except csv.Error as error:
        raise InputError(f"{path}: expected a table in CSV, got {error}; save it again") from None
    columns = lines[0] if lines else []
    rows = []
    for line in lines[1:]:
        cells = [cell.strip() for cell in line] + [""] * len(columns)
        rows.append(dict(zip(columns, cells, strict=False)))
    return columns, rows


def safe_file_name(student: str) -> str:
    """A unique file name for a student that is valid on every system and can be read."""
    plain = re.sub(r"[^\w@+-]+", "_", unicodedata.normalize("NFC", student)).strip("_")[:48]
    mark = hashlib.sha256(student.encode()).hexdigest()[:6]
    return student if plain == student else f"{plain or 'student'}-{mark}"


def spreadsheet_cell(value: object) -> object:
    """A value as a spreadsheet cell; texts that a spreadsheet could take for formulas get a '.

    A formula may begin behind blanks and characters that cannot be seen, in full-width or other
    forms of the same sign, and behind a semicolon, tabulator or line end, where a spreadsheet of
    another country begins a new cell.
    """
    if value is None:
        return ""
    if not isinstance(value, str):
        return value
    parts = _CELL_END.split(value)
    return "".join(f"'{part}" if _begins_formula(part) else part for part in parts)


def _begins_formula(text: str) -> bool:
    seen = (letter for letter in text if letter.isprintable() and not letter.isspace())
    first = unicodedata.normalize("NFKC", next(seen, ""))[:1]
    return text[:1] in ("\t", "\r") or (first != "" and first in _FORMULA_SIGNS)
