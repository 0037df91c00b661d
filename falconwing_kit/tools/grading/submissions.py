"""Submissions: a notebook, folder or learning platform's zip -> each student's notebook.

Nothing is unpacked to disk. Who a student is, only the first name below the folder or in the zip
says, which the platform or the teacher gave; names, folders and dates below it are the student's:

    ada.ipynb, lab03_ada.ipynb                               ada
    ada/lab03.ipynb, ada.zip                                 ada      (a folder or zip per student)
    Ada Lovelace_4711_assignsubmission_file_/lab03.ipynb     Ada Lovelace_4711      (Moodle)
    lovelaceada_LATE_123_456_lab03-2.ipynb                   lovelaceada_123        (Canvas)
    submission_9/lab03.ipynb                                 by the list beside it  (Gradescope)

Files that are no notebooks are listed too, so that nobody who handed in one is lost.
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
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any, BinaryIO

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import MAX_FILE

MAX_ENTRIES = 20_000  # of a zip or a student's folder
MAX_ZIPS, MAX_TRIED = 5, 5  # of a student: zips in a folder or zip; files tried for a notebook
# beginnings of a first name; what follows them is the student's file name
_CANVAS = re.compile(r"([^_]+)_(LATE_)?(\d+)_(?:question_\d+_)?\d+_")
_MOODLE = re.compile(r"(.+?)_assignsubmission_")
_GRADESCOPE, _LIST = re.compile(r"assignment_\d+_export"), "submission_metadata.yml"
_ITS_FOLDER = re.compile(r"submission_\d+")
_VERSION = re.compile(r"(?:-|_|\()(\d{1,4})\)?$")  # lab03-2, lab03 (2)
_LEADS_OUT, _LINK = "a name that leads out of the zip", "a link, which is not followed"
_SKIPPED = {"__MACOSX", ".ipynb_checkpoints", ".git", ".DS_Store", "Thumbs.db", "desktop.ini"}
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
        platform: "moodle", "canvas", "gradescope"; "folder" for a student's folder or zip by the
            teacher; empty for a single file.
        name_given: of the student, by the platform, without a number.
        number, email: of the student, by the platform, such as "canvas:123"; may be empty.
        late: whether the platform says so.
        handed_in: time by the platform, ISO 8601; empty if unknown.
        known: whether the student is on the course's roster, if there is one.
        other: it is a file of another kind.
    """

    student: str
    file: Path
    members: tuple[str, ...] = ()
    when: float | None = None
    sha256: str = ""
    problem: str = ""
    entry: str = ""
    disputed: bool = False
    platform: str = ""
    name_given: str = ""
    number: str = ""
    email: str = ""
    late: bool = False
    handed_in: str = ""
    known: bool = True
    other: bool = False

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


@dataclass(frozen=True)
class _File:
    """A file of an export, in a student's own zip too.

    Attributes:
        outer: path below the folder or in the export's zip, by the platform's names at first.
        inner: path in the student's zip; empty outside of one.
        found: where it is, its time, and why it cannot be read.
    """

    outer: PurePosixPath
    found: Submission
    inner: PurePosixPath = field(default_factory=PurePosixPath)

    @property
    def path(self) -> PurePosixPath:
        """Its own path, by which its kind is known."""
        return self.inner if self.inner.parts else self.outer

    @property
    def first(self) -> str:
        """The name that says whose it is."""
        return self.outer.parts[0]

    @property
    def second(self) -> str:
        """The name below it; empty for a file."""
        return (*self.outer.parts, "")[1]


def find_submissions(path: str | Path, lab: str) -> list[Submission]:
    """Every student's notebook of a lab.

    Args:
        path: a notebook, a folder, or a zip.
        lab: its name, "lab03"; of a student's several notebooks the one with this name counts, then
            the newest.

    Returns:
        One for each student, by name; links, unsafe paths and students who handed in other files
        only are reported. Other files beside students' folders or notebooks are passed over.

    Raises:
        InputError: there is nothing at the path, or no notebook.
    """
    found = [each for each in find_hand_ins(path, lab) if each.platform or not each.other]
    if not found:
        raise InputError(f"{path}: expected notebooks (.ipynb) in it, found none")
    return found


def find_hand_ins(path: str | Path, lab: str) -> list[Submission]:
    """As `find_submissions`, with every file that could be somebody's hand-in."""
    place = Path(path)
    if place.is_dir():
        files = list(_in_folder(place))
    elif place.is_file():
        files = list(_in_export(place))
    else:
        raise InputError(
            f"{place}: expected a notebook, a folder of notebooks or a zip, found nothing there"
        )
    files = [each for each in files if not {*each.outer.parts, *each.inner.parts} & _SKIPPED]
    if {bool(_GRADESCOPE.fullmatch(each.first)) and each.second != "" for each in files} == {True}:
        if place.is_dir():
            raise InputError(f"{place}: expected an export, got one in a folder; give that folder")
        files = [replace(f, outer=PurePosixPath(*f.outer.parts[1:])) for f in files]
    lists = [each for each in files if each.outer == PurePosixPath(_LIST)]
    names = {each.first for each in files} - {_LIST}
    listed = lists and all(map(_ITS_FOLDER.fullmatch, names))
    groups = _read_list(lists[0].found.read()) if listed else None
    if groups is None:
        _refuse_outer_folder(place, files)
    found: dict[str, list[Submission]] = {}
    for file in files:
        for each in _owned(file) if groups is None else _of_group(file, groups):
            found.setdefault(each.student, []).append(each)
    return [_stamped(_chosen(found[name], lab)) for name in sorted(found)]


def find_one(folder: Path, lab: str, student: str) -> Submission:
    """The notebook in one student's folder, whatever the files in it are called.

    Raises:
        InputError: there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a student's folder, found none")
    files = [each for each in _in_students_folder(folder) if not {*each.path.parts} & _SKIPPED]
    mine = [replace(_kind(each), student=student, entry=student) for each in files]
    return _stamped(_chosen(mine, lab))


def student_of(path: PurePosixPath) -> str:
    """Student of a file, from the first name of its path below the folder or in the zip."""
    return _owned(_File(path, Submission("", Path())))[0].student


def _owned(file: _File) -> list[Submission]:
    """A file with its student, and what identifies the student there: names of one platform with
    the same beginning are one student's, other names one each.
    """
    found, name = _kind(file), file.first
    canvas, moodle = _CANVAS.match(name), _MOODLE.match(name)
    if canvas:
        found = replace(
            found,
            entry=f"{canvas[1]}_{canvas[3]}",
            platform="canvas",
            name_given=_printable(canvas[1]),
            number=f"canvas:{canvas[3]}",
            late=canvas[2] is not None,
        )
    elif moodle:
        given = _printable(re.sub(r"_\d+$", "", moodle[1]))
        found = replace(found, entry=moodle[1], platform="moodle", name_given=given)
    if canvas or moodle:
        return [replace(found, student=_printable(found.entry).strip() or "unnamed")]
    plain = name if file.second else PurePosixPath(name).stem
    plain = plain if file.second else re.sub(r"^lab\d+[-_ ]+|[-_ ]+lab\d+$", "", plain)
    if found.problem == _LEADS_OUT and not file.inner.parts:  # the platform makes no such names
        plain = str(file.path)
    kind = "folder" if file.second or file.inner.parts else ""
    student = _printable(plain).strip() or "unnamed"
    return [replace(found, student=student, entry=name, platform=kind)]


def _of_group(file: _File, groups: Mapping[str, list[dict[str, Any]]]) -> list[Submission]:
    """A file of Gradescope's export, once for each student of its group."""
    found = _kind(file)
    if file.outer == PurePosixPath(_LIST):
        return []
    if file.first not in groups:
        return [replace(found, student=_printable(file.first), entry=file.first, other=True)]
    return [
        replace(
            found,
            student=one["email"] or one["number"] or one["name_given"] or file.first,
            entry=f"{file.first} {one['email']}",
            platform="gradescope",
            **one,
        )
        for one in groups[file.first]
    ]


def _read_list(data: bytes) -> dict[str, list[dict[str, Any]]]:
    """Gradescope's list of an export: by folder the students of the group."""
    import yaml  # type: ignore[import-untyped]

    found = {}
    try:
        for folder, each in yaml.safe_load(data).items():
            time = each.get(":created_at")
            found[str(folder)] = [
                {
                    "name_given": _printable(str(one.get(":name") or "")),
                    "number": _printable(str(one.get(":sid") or "")),
                    "email": _printable(str(one.get(":email") or "")),
                    "handed_in": time.isoformat() if hasattr(time, "isoformat") else "",
                }
                for one in each[":submitters"]
            ]
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError, RecursionError):
        raise InputError(f"{_LIST}: expected Gradescope's list of an export, got another") from None
    return found


def _kind(file: _File) -> Submission:
    """What is found, with a note if it has not a notebook's ending."""
    found, name = file.found, _printable(file.path.name)
    if found.problem or file.path.suffix.lower() == ".ipynb":
        return found
    return replace(found, other=True, problem=f"not a notebook: {name}")


def _renamed(several: list[Submission]) -> list[Submission]:
    """The first of a student's other files that begins like a notebook."""
    tried = 0
    for each in several:
        name = PurePosixPath(each.name)
        likely = name.suffix.lower() in ("", ".json", ".txt") or ".ipynb" in each.name.lower()
        if each.other and likely and each.when is not None and tried < MAX_TRIED:
            tried += 1
            with suppress(InputError):
                if each.read()[:64].lstrip(b"\xef\xbb\xbf \r\n\t")[:1] == b"{":
                    return [replace(each, other=False, problem=f"not called .ipynb: {each.name}")]
    return []


def _is_platform_name(name: str) -> bool:
    return bool(_CANVAS.match(name) or _MOODLE.match(name))


def _printable(name: str) -> str:
    letters = (letter for letter in unicodedata.normalize("NFC", name) if letter.isprintable())
    return "".join(letters)[:80]


def _refuse_outer_folder(place: Path, files: Iterable[_File]) -> None:
    """Raise InputError for an export inside one more folder.

    A student could forge the names in a folder, so they are not taken for the platform's.
    """
    below = {(each.first, each.second) for each in files}
    names = {first for first, _ in below}
    alone = len(names) == 1 and not any(map(_is_platform_name, names))
    if alone and all(_is_platform_name(second) for _, second in below):
        raise InputError(
            f"{place}: expected students' files or folders, got one folder, "
            f"{_printable(names.pop())}, with a platform's names in it; if it is the "
            "platform's export, give that folder"
        )


def _in_folder(folder: Path) -> Iterator[_File]:
    """Files in a folder and its subfolders, without following links."""
    for top in sorted(folder.iterdir()):
        if top.is_dir() and not top.is_symlink():
            yield from _in_students_folder(top)
        else:
            yield from _on_disk(top, PurePosixPath(top.name))


def _in_students_folder(top: Path) -> list[_File]:
    """Files of one student's folder; only the problem if they are too many, or none."""
    files: list[_File] = []
    count = zips = 0
    inside = PurePosixPath(top.name, ".")
    for here, folders, names in os.walk(top):
        folders[:] = sorted(name for name in folders if name not in _SKIPPED)
        for name in sorted(names):
            count, zips = count + 1, zips + name.lower().endswith(".zip")
            if count > MAX_ENTRIES or zips > MAX_ZIPS:
                much = f"more than {MAX_ENTRIES} files or {MAX_ZIPS} zips"
                return [_File(PurePosixPath(top.name, "x"), Submission("", top, problem=much))]
            file = Path(here, name)
            files += _on_disk(file, PurePosixPath(file.relative_to(top.parent).as_posix()))
    nothing = Submission("", top, problem="an empty folder")
    return files or [_File(inside / "x", nothing)]


def _on_disk(file: Path, path: PurePosixPath) -> Iterator[_File]:
    """A file on disk, or those in it if it is a student's zip."""
    found = Submission("", file)
    if file.is_symlink():
        yield _File(path, replace(found, problem=_LINK))
    elif path.suffix.lower() != ".zip":
        yield _File(path, replace(found, when=file.stat().st_mtime))
    else:
        yield from _in_students_zip(lambda: _open_plain(file), _File(path, found))


def _in_export(file: Path) -> Iterator[_File]:
    """A notebook, or the files in the class's zip."""
    path, found = PurePosixPath(file.name), Submission("", file)
    if path.suffix.lower() != ".zip":
        yield _File(path, replace(found, when=file.stat().st_mtime))
        return
    try:
        with _open_plain(file) as handle:
            yield from _in_zip(handle, found)
    except _UNREADABLE as error:
        why = f"not a zip that can be read: {type(error).__name__}"
        yield _File(path, replace(found, problem=why))


def _in_students_zip(open_it: Callable[[], BinaryIO], mine: _File) -> Iterator[_File]:
    """Files in a student's zip, all of them the student's."""
    try:
        with open_it() as handle:
            files = list(_in_zip(handle, mine.found, own=True))
    except (InputError, *_UNREADABLE) as error:
        why = f"not a zip that can be read: {type(error).__name__}"
        files = [_File(mine.outer, replace(mine.found, when=None, problem=why))]
    nothing = replace(mine.found, when=None, problem="an empty zip")
    for each in files or [_File(mine.outer, nothing)]:
        inner = each.path if each.found.members != mine.found.members else PurePosixPath()
        yield _File(mine.outer, each.found, inner)


def _in_zip(handle: BinaryIO, outer: Submission, *, own: bool = False) -> Iterator[_File]:
    """Files in a zip and in the students' zips in it; unsafe names are reported.

    Args:
        handle: the zip.
        outer: its location.
        own: it is a student's.
    """
    zips = 0
    with zipfile.ZipFile(handle) as archive:
        if len(archive.infolist()) > MAX_ENTRIES:
            raise ValueError(f"more than {MAX_ENTRIES} files")
        full = {
            PurePosixPath(each.filename).parts[:1]
            for each in archive.infolist()
            if not each.is_dir()
        }
        for entry in archive.infolist():
            path = PurePosixPath(entry.filename.replace("\\", "/"))
            found = replace(
                outer, members=(*outer.members, entry.filename), when=_seconds(entry.date_time)
            )
            if not path.parts or set(path.parts) & _SKIPPED:
                continue
            if entry.is_dir():
                if path.parts[:1] not in full and not outer.members and len(path.parts) == 1:
                    nothing = replace(found, when=None, problem="an empty folder")
                    yield _File(path / "x", nothing)
            elif path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
                yield _File(path, replace(found, when=None, problem=_LEADS_OUT))
            elif stat.S_ISLNK(entry.external_attr >> 16):
                yield _File(path, replace(found, when=None, problem=_LINK))
            elif path.suffix.lower() != ".zip":
                yield _File(path, found)
            elif outer.members:
                yield _File(path, replace(found, when=None, problem="a zip in a zip in a zip"))
            else:
                inner = partial(_open_member, archive, entry)
                zips += 1
                if own and zips > MAX_ZIPS:
                    raise ValueError(f"more than {MAX_ZIPS} zips")
                yield from _in_students_zip(inner, _File(path, found))


def _open_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> BinaryIO:
    return io.BytesIO(_at_most(archive.open(entry)))


def _seconds(date: tuple[int, ...]) -> float:
    """A zip's date as a time [s]; 0 for one that is none."""
    try:
        return float(calendar.timegm((*date, 0, 0, 0)))
    except (ValueError, OverflowError):
        return 0.0


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
    notebooks = [each for each in several if not each.other] or _renamed(several)
    if not notebooks:
        notebooks = [replace(each, when=None) for each in several]
    entries = sorted({_printable(each.entry) for each in notebooks})
    if len({each.entry for each in notebooks}) > 1:
        return replace(
            notebooks[0],
            when=None,
            disputed=True,
            problem=f"several have this name: {', '.join(entries)[:200]}; rename or remove all but "
            "the student's own",
        )
    best = max(notebooks, key=lambda each: _rank(each, lab))
    if best.other and len(several) > 1:
        names = sorted({each.name for each in several})
        return replace(best, problem=f"not notebooks: {', '.join(names)[:200]}")
    if len(notebooks) > 1 and not best.problem:
        return replace(
            best, problem=f"one of {len(notebooks)} notebooks of this student: {best.name}"
        )
    return best


def _rank(each: Submission, lab: str) -> tuple[object, ...]:
    """Order of one student's notebooks, the relevant one last."""
    version = _VERSION.search(PurePosixPath(each.name).stem)
    number = int(version[1]) if version else 0
    readable = each.when is not None
    return readable, lab in each.name, not each.problem, each.when or 0.0, number, each.name


def _stamped(each: Submission) -> Submission:
    """The submission with the fingerprint of its bytes, or the reason for its absence."""
    if each.when is None:
        return each
    try:
        return replace(each, sha256=hashlib.sha256(each.read()).hexdigest())
    except InputError as error:
        return replace(each, when=None, problem=str(error))
