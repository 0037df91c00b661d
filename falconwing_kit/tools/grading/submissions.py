"""Submissions: a notebook, folder or learning platform's zip -> each student's notebook.

Students are identified by the platform's file names; nothing is unpacked to disk:

    ada.ipynb, lab03_ada.ipynb                               ada
    ada/lab03.ipynb                                          ada      (a folder per student)
    Ada Lovelace_4711_assignsubmission_file_/lab03.ipynb     Ada Lovelace_4711      (Moodle)
    lovelaceada_LATE_123_456_lab03-2.ipynb                   lovelaceada_123        (Canvas)
"""

import hashlib
import io
import os
import re
import stat
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import MAX_FILE

MAX_ENTRIES = 20_000  # of a zip or a folder
_MOODLE = re.compile(r"([^/]+)_assignsubmission_")
_CANVAS = re.compile(r"(?:^|/)([^_/]+)_(?:LATE_)?(\d+)_(?:question_\d+_)?\d+_")
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
        when: time of the last change, to choose among several notebooks of one student.
        sha256: of the notebook's bytes; empty if unreadable.
        problem: why it cannot be read (then `when` is empty), or a note; else empty.
    """

    student: str
    file: Path
    members: tuple[str, ...] = ()
    when: tuple[float, ...] = ()
    sha256: str = ""
    problem: str = ""

    @property
    def name(self) -> str:
        """The notebook's file name, as it can be printed."""
        return _printable(PurePosixPath(self.members[-1] if self.members else self.file.name).name)

    def read(self) -> bytes:
        """The notebook's bytes.

        Raises:
            InputError: it cannot be read, or is too large.
        """
        if self.problem and not self.when:
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
    """Student of a file, from its path below the folder or in the zip."""
    whole = "/".join(path.parts)
    moodle, canvas = _MOODLE.search(whole), _CANVAS.search(whole)
    if moodle:
        name = moodle[1]
    elif canvas:
        name = f"{canvas[1]}_{canvas[2]}"
    elif len(path.parts) > 1:
        name = path.parts[0]
    else:
        name = re.sub(r"^lab\d+[-_ ]+|[-_ ]+lab\d+$", "", path.stem)
    return _printable(name).strip() or "unnamed"


def _printable(name: str) -> str:
    return "".join(letter for letter in name if letter.isprintable())[:80]


def _in_folder(folder: Path) -> Iterator[Submission]:
    """Notebooks in a folder and its subfolders, without following links."""
    entries = 0
    for here, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if name not in _SKIPPED)
        for file in (Path(here, name) for name in sorted(files)):
            entries += 1
            if entries > MAX_ENTRIES:
                raise InputError(
                    f"{folder}: expected at most {MAX_ENTRIES} files, found more; "
                    "name the right folder"
                )
            yield from _in_file(file, PurePosixPath(file.relative_to(folder).as_posix()))


def _in_file(file: Path, path: PurePosixPath | None = None) -> Iterator[Submission]:
    """Content of a file on disk: a notebook, or a zip of them.

    Args:
        file: the file.
        path: relative to the searched folder; None for the platform's export itself.
    """
    shown = path or PurePosixPath(file.name)
    if shown.suffix.lower() not in (".ipynb", ".zip"):
        return
    mine = Submission(student_of(shown), file)
    if file.is_symlink():
        yield replace(mine, problem="a link, which is not followed")
    elif shown.suffix.lower() == ".ipynb":
        yield replace(mine, when=(file.stat().st_mtime,))
    else:
        try:
            with _open_plain(file) as handle:
                yield from _in_zip(
                    handle,
                    replace(mine, student=""),
                    path.with_suffix("") if path else PurePosixPath(),
                )
        except _UNREADABLE as error:
            yield replace(mine, problem=f"not a zip that can be read: {type(error).__name__}")


def _in_zip(handle: BinaryIO, outer: Submission, base: PurePosixPath) -> Iterator[Submission]:
    """Notebooks in a zip and in the students' zips inside; unsafe names are reported.

    Args:
        handle: the zip.
        outer: its location.
        base: prefix of its names for `student_of`.
    """
    with zipfile.ZipFile(handle) as archive:
        if len(archive.infolist()) > MAX_ENTRIES:
            raise ValueError(f"more than {MAX_ENTRIES} files")
        for entry in archive.infolist():
            path = PurePosixPath(entry.filename.replace("\\", "/"))
            if (
                path.suffix.lower() not in (".ipynb", ".zip")
                or set(path.parts) & _SKIPPED
                or entry.is_dir()
            ):
                continue
            place = (*outer.members, entry.filename)
            found = replace(
                outer,
                student=student_of(base / path),
                members=place,
                when=tuple(map(float, entry.date_time)),
            )
            if path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
                name = student_of(PurePosixPath(path.name))
                yield replace(
                    found, student=name, when=(), problem="a name that leads out of the zip"
                )
            elif stat.S_ISLNK(entry.external_attr >> 16):
                yield replace(found, when=(), problem="a link, which is not followed")
            elif path.suffix.lower() == ".ipynb":
                yield found
            elif outer.members:
                yield replace(found, when=(), problem="a zip in a zip in a zip")
            else:
                yield from _in_inner_zip(archive, found, base / path.with_suffix(""))


def _in_inner_zip(
    archive: zipfile.ZipFile, found: Submission, base: PurePosixPath
) -> Iterator[Submission]:
    try:
        yield from _in_zip(io.BytesIO(_at_most(archive.open(found.members[-1]))), found, base)
    except (InputError, *_UNREADABLE) as error:
        yield replace(found, when=(), problem=f"not a zip that can be read: {type(error).__name__}")


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
    """The relevant notebook of a student's several: of this lab, readable, the newest."""
    best = max(several, key=lambda each: (lab in each.name, not each.problem, each.when, each.name))
    if len(several) > 1 and not best.problem:
        return replace(
            best, problem=f"one of {len(several)} notebooks of this student: {best.name}"
        )
    return best


def _stamped(each: Submission) -> Submission:
    """The submission with the fingerprint of its bytes, or the reason for its absence."""
    if not each.when:
        return each
    try:
        return replace(each, sha256=hashlib.sha256(each.read()).hexdigest())
    except InputError as error:
        return replace(each, problem=str(error))
