"""Submissions: a notebook, folder or learning platform's zip -> each student's notebook.

Nothing is unpacked to disk. Who a student is, only the first name below the folder or in the zip
says, which the platform or the teacher gave; names, folders and dates below it are the student's:

    ada.ipynb, lab03_ada.ipynb                               ada
    ada/lab03.ipynb, ada.zip                                 ada      (a folder or zip per student)
    Ada Lovelace_4711_assignsubmission_file_/lab03.ipynb     Ada Lovelace_4711      (Moodle)
    lovelaceada_LATE_123_456_lab03-2.ipynb                   lovelaceada_123        (Canvas)
"""

import calendar
import hashlib
import io
import os
import re
import stat
import unicodedata
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import MAX_FILE

MAX_ENTRIES = 20_000  # of a zip or a folder
# beginnings of a first name; what follows them is the student's file name
_CANVAS = re.compile(r"([^_]+)_(?:LATE_)?(\d+)_(?:question_\d+_)?\d+_")
_MOODLE = re.compile(r"(.+?)_assignsubmission_")
_VERSION = re.compile(r"(?:-|_|\()(\d{1,4})\)?$")  # lab03-2, lab03 (2)
_SKIPPED = {"__MACOSX", ".ipynb_checkpoints", ".git"}
_UNREADABLE = (
    OSError,
    zipfile.BadZipFile,
    RuntimeError,
    EOFError,
    ValueError,
    KeyError,
    zlib.error,
)


@dataclass(frozen=True)
class Submission:
    """One student's notebook.

    Attributes:
        student: name from the file or folder.
        file: on disk: the notebook, or the zip that holds it.
        members: in a zip: the notebook's name; two names for a zip inside a zip.
        when: time of the last change [s], to choose among several notebooks of one student; None
            if it cannot be read.
        sha256: of the notebook's bytes; empty if unreadable.
        problem: why it cannot be read, or a note; else empty.
        entry: the first name below the folder or in the zip, which says whose it is.
        disputed: several entries have this student's name, and a person must decide.
    """

    student: str
    file: Path
    members: tuple[str, ...] = ()
    when: float | None = None
    sha256: str = ""
    problem: str = ""
    entry: str = ""
    disputed: bool = False

    @property
    def name(self) -> str:
        """The notebook's file name, as it can be printed."""
        return _printable(PurePosixPath(self.members[-1] if self.members else self.file.name).name)

    def read(self) -> bytes:
        """The notebook's bytes.

        Raises:
            InputError: it cannot be read, or is too large.
        """
        if self.problem and self.when is None:
            raise InputError(self.problem)
        try:
            with _open_plain(self.file) as handle:
                if not self.members:
                    return _at_most(handle)
                data = _read_member(handle, self.members[0])
            return (
                _read_member(io.BytesIO(data), self.members[1]) if len(self.members) > 1 else data
            )
        except InputError:
            raise
        except _UNREADABLE as error:
            raise InputError(
                f"the notebook cannot be read ({type(error).__name__}); ask for it again"
            ) from None


def find_submissions(path: str | Path, lab: str) -> list[Submission]:
    """Every student's notebook of a lab.

    Args:
        path: a notebook, a folder, or a zip.
        lab: its name, "lab03"; of a student's several notebooks the one with this name counts, then
            the newest.

    Returns:
        One for each student, by name; links and unsafe paths are reported, not followed.

    Raises:
        InputError: there is nothing at the path, or no notebook.
    """
    place = Path(path)
    if place.is_dir():
        found = list(_in_folder(place))
    elif place.is_file():
        found = list(_in_file(place))
    else:
        raise InputError(
            f"{place}: expected a notebook, a folder of notebooks or a zip, found nothing there"
        )
    if not found:
        raise InputError(f"{place}: expected notebooks (.ipynb) in it, found none")
    students: dict[str, list[Submission]] = {}
    for each in found:
        students.setdefault(each.student, []).append(each)
    return [_stamped(_chosen(students[name], lab)) for name in sorted(students)]


def student_of(path: PurePosixPath) -> str:
    """Student of a file, from the first name of its path below the folder or in the zip."""
    return _owner(path.parts[0], is_file=len(path.parts) == 1)[0]


def _owner(name: str, *, is_file: bool) -> tuple[str, str]:
    """Student of a first name, and what identifies the student there: names of one platform with
    the same beginning are one student's, other names one each.
    """
    canvas, moodle = _CANVAS.match(name), _MOODLE.match(name)
    if canvas:
        return _printable(f"{canvas[1]}_{canvas[2]}"), f"{canvas[1]}_{canvas[2]}"
    if moodle:
        return _printable(moodle[1]).strip() or "unnamed", moodle[1]
    plain = re.sub(r"^lab\d+[-_ ]+|[-_ ]+lab\d+$", "", PurePosixPath(name).stem)
    return _printable(plain if is_file else name).strip() or "unnamed", name


def _is_platform_name(name: str) -> bool:
    return bool(_CANVAS.match(name) or _MOODLE.match(name))


def _printable(name: str) -> str:
    letters = (letter for letter in unicodedata.normalize("NFC", name) if letter.isprintable())
    return "".join(letters)[:80]


def _refuse_outer_folder(place: Path, below: Mapping[str, AbstractSet[str]]) -> None:
    """Raise InputError for an export inside one more folder.

    A student could forge the names in a folder, so they are not taken for the platform's.

    Args:
        place: the folder or zip.
        below: by first name, the second names; a file has none.
    """
    if len(below) == 1:
        ((name, inside),) = below.items()
        if inside and not _is_platform_name(name) and all(map(_is_platform_name, inside)):
            raise InputError(
                f"{place}: expected students' files or folders, got one folder, "
                f"{_printable(name)}, with a platform's names in it; if it is the platform's "
                "export, give that folder"
            )


def _in_folder(folder: Path) -> Iterator[Submission]:
    """Notebooks in a folder and its subfolders, without following links."""
    names = sorted(name for name in os.listdir(folder) if name not in _SKIPPED)
    below = {}
    for path in (folder / name for name in names):
        inside = os.listdir(path) if path.is_dir() and not path.is_symlink() else ()
        below[path.name] = {name for name in inside if name not in _SKIPPED}
    _refuse_outer_folder(folder, below)
    for path in (folder / name for name in names):
        if path.is_symlink() or not path.is_dir():
            yield from _in_file(path, PurePosixPath(path.name))
        else:
            yield from _in_students_folder(folder, path)


def _in_students_folder(folder: Path, mine: Path) -> list[Submission]:
    """Notebooks of one student's folder; only the problem if it holds too many files."""
    found: list[Submission] = []
    entries = 0
    for here, folders, files in os.walk(mine):
        folders[:] = sorted(name for name in folders if name not in _SKIPPED)
        for file in (Path(here, name) for name in sorted(files)):
            entries += 1
            if entries > MAX_ENTRIES:
                student, entry = _owner(mine.name, is_file=False)
                much = f"more than {MAX_ENTRIES} files"
                return [Submission(student, mine, problem=much, entry=entry)]
            found += _in_file(file, PurePosixPath(file.relative_to(folder).as_posix()))
    return found


def _in_file(file: Path, path: PurePosixPath | None = None) -> Iterator[Submission]:
    """Content of a file on disk: a notebook, or a zip of them.

    Args:
        file: the file.
        path: relative to the searched folder; None for the platform's export itself.
    """
    shown = path or PurePosixPath(file.name)
    student, entry = _owner(shown.parts[0], is_file=len(shown.parts) == 1)
    mine = Submission(student, file, entry=entry)
    if file.is_symlink():
        yield replace(mine, problem="a link, which is not followed")
    elif shown.suffix.lower() == ".ipynb":
        yield replace(mine, when=file.stat().st_mtime)
    elif shown.suffix.lower() == ".zip":
        try:
            with _open_plain(file) as handle:
                yield from _in_zip(handle, mine, is_export=path is None)
        except InputError:
            raise
        except _UNREADABLE as error:
            yield replace(mine, problem=f"not a zip that can be read: {type(error).__name__}")


def _in_zip(handle: BinaryIO, outer: Submission, *, is_export: bool) -> Iterator[Submission]:
    """Notebooks in a zip and in the students' zips inside; unsafe names are reported.

    Args:
        handle: the zip.
        outer: its location, and whose it is.
        is_export: it is the class's, so that its first names say whose a file is.
    """
    with zipfile.ZipFile(handle) as archive:
        if len(archive.infolist()) > MAX_ENTRIES:
            raise ValueError(f"more than {MAX_ENTRIES} files")
        paths = [PurePosixPath(each.filename.replace("\\", "/")) for each in archive.infolist()]
        if is_export:
            below: dict[str, set[str]] = {}
            for path in paths:
                if path.parts and not set(path.parts) & _SKIPPED:
                    below.setdefault(path.parts[0], set()).update(path.parts[1:2])
            _refuse_outer_folder(outer.file, below)
        for entry, path in zip(archive.infolist(), paths, strict=True):
            if (
                path.suffix.lower() not in (".ipynb", ".zip")
                or set(path.parts) & _SKIPPED
                or entry.is_dir()
            ):
                continue
            found = replace(
                outer, members=(*outer.members, entry.filename), when=_seconds(entry.date_time)
            )
            unsafe = path.is_absolute() or ".." in path.parts or ":" in path.parts[0]
            if is_export:
                first = str(path) if unsafe else path.parts[0]
                student, mine = _owner(first, is_file=unsafe or len(path.parts) == 1)
                found = replace(found, student=str(path) if unsafe else student, entry=mine)
            if unsafe:
                yield replace(found, when=None, problem="a name that leads out of the zip")
            elif stat.S_ISLNK(entry.external_attr >> 16):
                yield replace(found, when=None, problem="a link, which is not followed")
            elif path.suffix.lower() == ".ipynb":
                yield found
            elif outer.members:
                yield replace(found, when=None, problem="a zip in a zip in a zip")
            else:
                yield from _in_inner_zip(archive, found)


def _seconds(date: tuple[int, ...]) -> float:
    """A zip's date as a time [s]; 0 for one that is none."""
    try:
        return float(calendar.timegm((*date, 0, 0, 0)))
    except (ValueError, OverflowError):
        return 0.0


def _in_inner_zip(archive: zipfile.ZipFile, found: Submission) -> Iterator[Submission]:
    try:
        data = _at_most(archive.open(found.members[-1]))
        yield from _in_zip(io.BytesIO(data), found, is_export=False)
    except (InputError, *_UNREADABLE) as error:
        why = f"not a zip that can be read: {type(error).__name__}"
        yield replace(found, when=None, problem=why)


def _read_member(handle: BinaryIO, name: str) -> bytes:
    with zipfile.ZipFile(handle) as archive, archive.open(name) as member:
        return _at_most(member)


def _at_most(handle: IO[bytes]) -> bytes:
    """A file's content up to the size limit; sizes declared by a zip are not trusted."""
    data = handle.read(MAX_FILE + 1)
    if len(data) > MAX_FILE:
        raise InputError(
            f"expected a notebook of at most {MAX_FILE >> 20} MiB; clear its outputs and save it"
        )
    return data


def _open_plain(file: Path) -> BinaryIO:
    """Open a regular file for reading; links, pipes and devices are refused."""
    handle = os.open(
        file, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    )
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError("not a plain file")
    return os.fdopen(handle, "rb")


def _chosen(several: list[Submission], lab: str) -> Submission:
    """The relevant notebook of a student's several: of this lab, readable, the newest.

    Of two names that are not one student's for certain (`ada.ipynb` and `lab03_ada.ipynb`, or two
    that differ in letters that cannot be seen) none is taken: one of them may be somebody else's.
    """
    entries = sorted({_printable(each.entry) for each in several})
    if len({each.entry for each in several}) > 1:
        return replace(
            several[0],
            when=None,
            disputed=True,
            problem=f"several have this name: {', '.join(entries)[:200]}; rename or remove all but "
            "the student's own",
        )
    best = max(several, key=lambda each: _rank(each, lab))
    if len(several) > 1 and not best.problem:
        return replace(
            best, problem=f"one of {len(several)} notebooks of this student: {best.name}"
        )
    return best


def _rank(each: Submission, lab: str) -> tuple[object, ...]:
    """Order of one student's notebooks, the relevant one last."""
    version = _VERSION.search(PurePosixPath(each.name).stem)
    number = int(version[1]) if version else 0
    return lab in each.name, not each.problem, each.when or 0.0, number, each.name


def _stamped(each: Submission) -> Submission:
    """The submission with the fingerprint of its bytes, or the reason for its absence."""
    if each.when is None:
        return each
    try:
        return replace(each, sha256=hashlib.sha256(each.read()).hexdigest())
    except InputError as error:
        return replace(each, when=None, problem=str(error))
