"""Loading labs: the name of a lab -> its folder, its public checks and its hidden judges.

A lab's Python files are loaded by path under the short names that they have in every lab (`given`,
`checks`, `hidden`). The names are in `sys.modules` only while a file is loaded, so that labs do not
mix: import them at the top of a file, not inside a function.
"""

import ast
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import shipped_path
from falconwing_kit.tools.grading.lab import Course, Judge, Lab

_NEIGHBOURS = ("given", "checks", "hidden")  # a lab's files, in the order of loading


def labs_folder(path: str | Path | None = None) -> Path:
    """The folder that holds the labs.

    Args:
        path: None searches the working directory, its `labs`, its parent, and the checkout or the
            installation.

    Returns:
        A folder with at least one lab in it.

    Raises:
        InputError: there is no lab there.
    """
    here = Path.cwd()
    places = [here, here / "labs", here.parent] if path is None else [Path(path)]
    if path is None:
        with suppress(FileNotFoundError):
            places.append(shipped_path("labs/README.md", "give the labs by --labs").parent)
    for place in places:
        if lab_folders(place):
            return place
    looked = ", ".join(str(place) for place in places)
    raise InputError(
        f"labs: expected a folder with labs such as lab01_sizing, found none in {looked}; "
        "give it by --labs FOLDER"
    )


def lab_folders(labs: Path) -> list[Path]:
    """The labs in a folder, by number: folders such as `lab01_sizing` that hold `checks.py`."""
    found = labs.glob("lab[0-9][0-9]_*/checks.py")
    return sorted(checks.parent for checks in found)


def lab_folder(name: str | Path, labs: str | Path | None = None) -> Path:
    """The folder of one lab.

    Args:
        name: "lab03", "lab03_splats", or a folder with `checks.py`, such as "labs/_template".
        labs: as in `labs_folder`.

    Returns:
        The folder, which holds `checks.py`.

    Raises:
        InputError: there is no such lab.
    """
    if (Path(name) / "checks.py").is_file():
        return Path(name)
    folders = lab_folders(labs_folder(labs))
    found = [folder for folder in folders if str(name) in (folder.name, folder.name.split("_")[0])]
    if not found:
        raise InputError(
            f"{name}: expected one of {', '.join(folder.name for folder in folders)}, "
            "or a lab's folder"
        )
    return found[0]


def select_labs(names: Sequence[str], labs: str | Path | None = None) -> list[Path]:
    """Folders of the named labs, or of all numbered labs; raises as `lab_folder`."""
    return [lab_folder(name, labs) for name in names] or lab_folders(labs_folder(labs))


def notebook_path(folder: Path, *, solution: bool = False) -> Path:
    """Path of a lab's notebook: `lab03_splats/lab03.ipynb`, or the one in `solution`."""
    name = f"{folder.resolve().name.lstrip('_').split('_')[0]}.ipynb"
    return folder / "solution" / name if solution else folder / name


def load_checks(folder: Path) -> Lab:
    """The public part of a lab: LAB of its `checks.py`.

    Raises:
        InputError: the file is missing, cannot be run, or has no LAB.
    """
    lab = getattr(load_module(folder, "checks"), "LAB", None)
    if not isinstance(lab, Lab):
        raise InputError(
            f"{folder / 'checks.py'}: expected LAB, a falconwing_kit.tools.grading.Lab, got {lab!r}"
        )
    return lab


def load_judges(folder: Path, course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise: the result of `judges(course)` in the lab's `hidden.py`.

    While it is loaded, `given.COHORT` holds this course's constants, not those of `cohort.json`.

    Raises:
        InputError: the file is missing (students do not get it), fails, or omits an exercise.
    """
    expected = {exercise.name for exercise in load_checks(folder).exercises}
    judges: Mapping[str, tuple[Judge, ...]] = load_module(
        folder, "hidden", course.constants
    ).judges(course)
    if set(judges) != expected:
        raise InputError(
            f"{folder / 'hidden.py'}: expected judges of {sorted(expected)}, got {sorted(judges)}"
        )
    return judges


def load_module(
    folder: Path, name: str, constants: Mapping[str, float] | None = None
) -> types.ModuleType:
    """Load a lab's file with those that it imports, leaving nothing in `sys.modules`.

    Args:
        folder: the lab's.
        name: "given", "checks" or "hidden".
        constants: a course's constants, which replace `given.COHORT`.

    Raises:
        InputError: the file is missing, or running it failed.
    """
    path = folder / f"{name}.py"
    if not path.is_file():
        hint = (
            "students' folders do not have it; give a checkout's labs by --labs"
            if name == "hidden"
            else "use the lab's folder as it was handed out"
        )
        raise InputError(f"{path}: expected this file of the lab, found none; {hint}")
    before = _NEIGHBOURS[: _NEIGHBOURS.index(name)] if name in _NEIGHBOURS else _NEIGHBOURS
    with _reserved_names():
        for file in (*(folder / f"{neighbour}.py" for neighbour in before), path):
            if file.is_file():
                module = _run(file, constants if file.stem == "given" else None)
        return module


@contextmanager
def importable_given(module: types.ModuleType) -> Iterator[types.ModuleType]:
    """For a while a lab's given code is what `import given` finds, as in its notebook."""
    before = sys.modules.get("given")
    sys.modules["given"] = module
    try:
        yield module
    finally:
        sys.modules.pop("given")
        if before is not None:
            sys.modules["given"] = before


@contextmanager
def _reserved_names() -> Iterator[None]:
    """Remove a lab's module names from `sys.modules`, and restore them afterwards."""
    before = {name: sys.modules.pop(name) for name in _NEIGHBOURS if name in sys.modules}
    try:
        yield
    finally:
        for name in _NEIGHBOURS:
            sys.modules.pop(name, None)
        sys.modules.update(before)


def _run(path: Path, constants: Mapping[str, float] | None = None) -> types.ModuleType:
    """Run a file as a module under its short name; `constants` replace its COHORT."""
    module = types.ModuleType(path.stem)
    module.__file__ = str(path.resolve())
    sys.modules[path.stem] = module
    try:
        numbers = None if constants is None else tuple(constants.items())
        code = _compiled(module.__file__, path.read_text(encoding="utf-8"), numbers)
        exec(code, module.__dict__)
    except ModuleNotFoundError:
        raise  # the command line names the extra to install
    except Exception as error:
        text = " ".join(str(error).split())
        raise InputError(
            f"{path}: running it failed with {type(error).__name__}: {text}; correct the file"
        ) from error
    return module


@lru_cache(maxsize=32)  # a class's submissions load the same files again and again
def _compiled(
    path: str, text: str, constants: tuple[tuple[str, float], ...] | None
) -> types.CodeType:
    tree = ast.parse(text, path)
    if constants is not None:
        _put_constants(tree, dict(constants))
    return compile(tree, path, "exec")


def _put_constants(tree: ast.Module, constants: Mapping[str, float]) -> None:
    """Replace the value assigned to COHORT, so that numbers derived from it follow."""
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        if isinstance(node, ast.Assign | ast.AnnAssign) and "COHORT" in names:
            numbers = ast.parse(repr(dict(constants)), mode="eval").body
            node.value = ast.copy_location(numbers, node)
            ast.fix_missing_locations(tree)
            return
    raise ValueError("expected an assignment COHORT = ...")
