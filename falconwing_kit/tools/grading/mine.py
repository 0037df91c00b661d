"""Student's notebooks of the labs -> `my_falconwing`, a package of the parts that they wrote.

    my_falconwing/README.md         which functions are the student's, and which are the kit's
    my_falconwing/parts.json        the same for programs
    my_falconwing/renderer.py       lab 3's functions, one module for each lab
    my_falconwing/kit/renderer.py   the kit's, where the student's is missing or fails its check
    my_falconwing/given/lab03/      what the functions import as `given`

The kit's part is the function of the lab's solution, which has the same arguments as the student's;
`Part.kit` names the rooms of the kit that do the same for flights. A student's function is taken if
it passes the public checks of its lab, in a process of its own with the limits of `check`. Every
module is then loaded once in such a process; one that does not load is replaced by the kit's.
"""

import ast
import importlib
import importlib.util
import json
import shutil
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import shipped_path
from falconwing_kit.tools.grading.bounded import TooMuchError, call_bounded
from falconwing_kit.tools.grading.collect import (
    COLLECT_MIB,
    COLLECT_S,
    Notebook,
    collect_sources,
    read_notebook,
    written_statements,
)
from falconwing_kit.tools.grading.find import (
    lab_folder,
    lab_folders,
    labs_folder,
    load_checks,
    notebook_path,
)
from falconwing_kit.tools.grading.lab import Lab
from falconwing_kit.tools.grading.public_checks import check_notebook, exercise_state
from falconwing_kit.tools.grading.sandbox.host import SandboxJob, StudentError, process_worker

PACKAGE = "my_falconwing"
RECORD = "parts.json"
LOAD_S = 20.0  # limit of loading one module [s]


@dataclass(frozen=True)
class Part:
    """One module of the package.

    Attributes:
        module: its name.
        lab: where its functions are written, "lab03".
        what: it does.
        kit: files of the kit that do the same, for comparison.
    """

    module: str
    lab: str
    what: str
    kit: tuple[str, ...]


PARTS = (
    Part("sizing", "lab01", "mass, speed and room", ("aircraft/sizing.py",)),
    Part("camera", "lab02", "poses and pixels", ("core/frames.py", "scene/camera.py")),
    Part("renderer", "lab03", "Gaussians to a picture", ("scene/reference.py", "scene/fast.py")),
    Part(
        "aircraft",
        "lab04",
        "nine-state model and trim",
        ("aircraft/terms.py", "aircraft/integrate.py", "aircraft/trim.py"),
    ),
    Part(
        "identification",
        "lab05",
        "parameters from logs",
        ("sysid/prepare.py", "sysid/fit.py", "sysid/uncertainty.py", "sysid/forecast.py"),
    ),
    Part("poses", "lab06", "camera poses from pictures", ("vision/marker.py",)),
    Part("expert", "lab07", "guidance and landing", ("control/guidance.py", "control/expert.py")),
    Part("imitation", "lab08", "a policy by imitation", ("learning/imitation.py",)),
    Part("masks", "lab09", "segmentation of the leader", ("scene/masks.py",)),
    Part(
        "bridge",
        "lab10",
        "PPM, safety machine and frame monitor",
        ("trainer_port/ppm.py", "trainer_port/safety.py", "vision/monitor.py"),
    ),
    Part("landings", "lab11", "statistics of landings", ("flight/judges.py",)),
    Part("gap", "lab12", "what the model lacks", ("gap/measure.py", "gap/name.py")),
)


@dataclass(frozen=True)
class Choice:
    """One function of the package.

    Attributes:
        part, lab, function: its module, its lab, its name.
        mine: whether it is the student's; otherwise it is the kit's.
        why: reason for the kit's part; empty for the student's.
    """

    part: str
    lab: str
    function: str
    mine: bool
    why: str = ""


@dataclass(frozen=True)
class CheckedLab:
    """A lab as it enters the package.

    Attributes:
        part, lab: its module, and the public part of the kit's lab.
        folder: the student's, or the kit's if the student has none.
        kit: the kit's folder of the lab.
        notebook: the student's; None where there is no usable one.
        why: the kit's functions, with the reason.
    """

    part: Part
    lab: Lab
    folder: Path
    kit: Path
    notebook: Notebook | None
    why: Mapping[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the lab's functions."""
        return [exercise.name for exercise in self.lab.exercises]


def collect_mine(labs: Path | None, out: Path, kit_labs: Path | None = None) -> list[Choice]:
    """Write the package.

    Args:
        labs: folder with the student's labs; None for the kit's parts alone.
        out: the package's folder, new, empty, or written by an earlier call.
        kit_labs: the kit's labs, with solutions; found if None.

    Returns:
        Each function's origin, in the order of the labs.

    Raises:
        InputError: `out` holds something else or is no module's name, a lab of the kit is missing.
    """
    if not out.name.isidentifier():
        raise InputError(f"--out: expected a name that Python can import, got {out.name!r}")
    if out.exists() and not (out / RECORD).is_file() and (out.is_file() or any(out.iterdir())):
        raise InputError(
            f"{out}: expected a new folder, or one that collect-mine wrote; choose another"
        )
    kit = kit_labs or _kit_labs()
    return write_package(check_labs(labs, kit), out, verify=labs is not None)


def check_labs(labs: Path | None, kit_labs: Path) -> list[CheckedLab]:
    """Run the public checks of all labs on the student's notebooks.

    Args:
        labs: folder with the student's labs; None for none.
        kit_labs: the kit's labs, with solutions.
    """
    own = {} if labs is None else {folder.name[:5]: folder for folder in lab_folders(labs)}
    return [_check_lab(part, own.get(part.lab), lab_folder(part.lab, kit_labs)) for part in PARTS]


def write_package(labs: Sequence[CheckedLab], out: Path, *, verify: bool = True) -> list[Choice]:
    """Write the package of checked labs, complete or not at all; see `collect_mine`.

    Args:
        labs: each with the reasons for the kit's functions.
        out: the package's folder, which is replaced.
        verify: load every module that holds code of the student once, in a process of its own.
    """
    chosen = list(labs)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as temporary:
        package = Path(temporary) / out.name
        package.mkdir()
        for number, one in enumerate(chosen):
            _write_part(package, one)
            if verify and len(one.why) < len(one.names) and not _loads(package, one):
                lost = {name: one.why.get(name, "its module does not load") for name in one.names}
                chosen[number] = replace(one, notebook=None, why=lost)
                _write_part(package, chosen[number])
        choices = [
            Choice(one.part.module, one.part.lab, name, name not in one.why, one.why.get(name, ""))
            for one in chosen
            for name in one.names
        ]
        _write_cover(package, choices)
        shutil.rmtree(out, ignore_errors=True)
        package.rename(out)
    return choices


def load_parts(which: str | Path = "kit") -> ModuleType:
    """The parts to fly with, as a package whose modules load when they are first used.

    Args:
        which: "kit"; "mine" for `my_falconwing` in this folder or one above it; or a folder that
            `collect_mine` wrote.

    Returns:
        The package: `parts.renderer.splat_alphas` is lab 3's function.

    Raises:
        InputError: there is no such package.
    """
    folder = _kit_parts() if which == "kit" else _own_package() if which == "mine" else Path(which)
    if not (folder / RECORD).is_file():
        raise InputError(
            f"{folder}: expected a package of parts; run falconwing labs collect-mine first"
        )
    name = folder.name if which == "mine" else f"_parts_{abs(hash(str(folder.resolve())))}"
    for loaded in [each for each in sys.modules if each.split(".")[0] == name]:
        del sys.modules[loaded]  # collected again since
    importlib.invalidate_caches()
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    if spec is None or spec.loader is None:
        raise InputError(f"{folder}: expected a package with __init__.py; collect it again")
    package = importlib.util.module_from_spec(spec)
    sys.modules[name] = package
    spec.loader.exec_module(package)
    return package


def whose(parts: ModuleType | None, *modules: str) -> str:
    """What a lab says about the parts that it runs on: whose each function is, a line a module.

    Args:
        parts: of `load_parts`, or None for the lab's own data and code.
        modules: such as "renderer", "expert".
    """
    if parts is None:
        return f"{', '.join(modules)}: the lab's own code and data"
    record = Path(str(parts.__file__)).with_name(RECORD)
    functions = json.loads(record.read_text(encoding="utf-8"))["functions"]
    lines = []
    for module in modules:
        here = [each for each in functions if each["part"] == module]
        mine = [each["function"] for each in here if each["mine"]]
        kits = [f"{each['function']} ({each['why']})" for each in here if not each["mine"]]
        said = [f"yours {', '.join(mine)}"] if mine else []
        said += [f"the kit's {', '.join(kits)}"] if kits else []
        lines.append(f"{module}: {'; '.join(said)}")
    return "\n".join(lines)


@lru_cache(maxsize=1)
def _kept() -> ExitStack:
    return ExitStack()


@lru_cache(maxsize=1)
def _kit_parts() -> Path:
    """A package of the kit's parts alone, with the numbers of the labs around; made once."""
    kit = _kit_labs()
    try:
        around = labs_folder()
    except InputError:
        around = kit
    own = {folder.name[:5]: folder for folder in lab_folders(around)}
    labs = []
    for part in PARTS:
        folder = lab_folder(part.lab, kit)
        lab = load_checks(folder)
        why = dict.fromkeys([exercise.name for exercise in lab.exercises], "not asked for")
        labs.append(CheckedLab(part, lab, own.get(part.lab, folder), folder, None, why))
    temporary = tempfile.TemporaryDirectory(prefix="falconwing-parts-")
    _kept().enter_context(temporary)
    folder = Path(temporary.name) / "kit_parts"
    write_package(labs, folder, verify=False)
    return folder


def _own_package() -> Path:
    here = Path.cwd()
    for place in (here, *here.parents[:3]):
        if (place / PACKAGE / RECORD).is_file():
            return place / PACKAGE
    raise InputError(
        f"{PACKAGE}: expected it in {here} or a folder above, found none; "
        "run falconwing labs collect-mine there first"
    )


def _kit_labs() -> Path:
    return labs_folder(shipped_path("labs/README.md", "give the labs by --labs").parent)


def _check_lab(part: Part, own: Path | None, kit: Path) -> CheckedLab:
    """Run a lab's public checks on the student's notebook."""
    lab = load_checks(kit)
    names = [exercise.name for exercise in lab.exercises]
    if own is None:
        return CheckedLab(part, lab, kit, kit, None, dict.fromkeys(names, "no folder of this lab"))
    path = notebook_path(own)
    try:
        notebook = read_notebook(path)
        collect_sources(notebook, names, lab.packages)  # refuses code that takes too long to read
        reports = {report.name: report for report in check_notebook(own, path)}
    except FileNotFoundError:
        return CheckedLab(part, lab, own, kit, None, dict.fromkeys(names, "no notebook"))
    except InputError as error:
        return CheckedLab(part, lab, own, kit, None, dict.fromkeys(names, str(error)))
    why = {}
    for name in names:
        if name not in reports:
            why[name] = "this lab's checks.py does not have it"
        elif (state := exercise_state(reports[name].outcomes)) != "passed":
            claims = [each.claim for each in reports[name].outcomes if each.state == "failed"]
            why[name] = f"failed: {claims[0]}" if claims else state
    return CheckedLab(part, lab, own, kit, notebook, why)


def _write_part(package: Path, one: CheckedLab) -> None:
    """Write one module, the kit's part of it, and its given code."""
    module, mine = one.part.module, [name for name in one.names if name not in one.why]
    text = "" if one.notebook is None or not mine else _own_text(one, mine)
    mine = mine if text else []
    kit = [name for name in one.names if name not in mine]
    given = package / "given" / one.part.lab
    given.mkdir(parents=True, exist_ok=True)
    (package / "given" / "__init__.py").write_text('"""Given code of the labs, as handed out."""\n')
    home = one.folder if (one.folder / "given.py").is_file() else one.kit
    shutil.copyfile(home / "given.py", given / "__init__.py")
    shutil.copyfile(home / "cohort.json", given / "cohort.json")
    if (home / "data").is_dir():
        shutil.copytree(home / "data", given / "data", dirs_exist_ok=True)
    if kit:
        (package / "kit").mkdir(exist_ok=True)
        (package / "kit" / "__init__.py").write_text('"""The kit\'s parts."""\n')
        solution = read_notebook(notebook_path(one.kit, solution=True))
        body = _module_text(solution, kit, one.lab.packages, one.part.lab, "..given", set())
        (package / "kit" / f"{module}.py").write_text(
            f'"""The kit\'s {one.part.what}, lab {int(one.part.lab[3:])}: {", ".join(kit)}."""\n\n'
            + body,
            encoding="utf-8",
        )
    lines = [f'"""{one.part.what[0].upper()}{one.part.what[1:]} (lab {int(one.part.lab[3:])}).', ""]
    lines += [f"Mine: {', '.join(mine) or 'nothing'}."]
    lines += [f"The kit's: {', '.join(kit)}."] if kit else []
    lines += [f"The same in the kit: {', '.join(one.part.kit)}.", '"""', ""]
    future, _, rest = text.partition("\n") if text.startswith("from __future__") else ("", "", text)
    lines += [future, ""] if future else []
    lines += [f"from .kit.{module} import {', '.join(kit)}", ""] if kit else []
    lines += [rest] if rest else []
    lines += [f"__all__ = {sorted(one.names)!r}", ""]
    (package / f"{module}.py").write_text("\n".join(lines), encoding="utf-8")


def _own_text(one: CheckedLab, mine: Sequence[str]) -> str:
    """The student's functions with what they need, or nothing if they cannot be read."""
    assert one.notebook is not None
    notebook = one.notebook
    replaced = set(one.names) - set(mine)
    try:
        return str(
            call_bounded(
                lambda: _module_text(
                    notebook, mine, one.lab.packages, one.part.lab, ".given", replaced
                ),
                4.0 * COLLECT_S,
                COLLECT_MIB,
            )
        )
    except TooMuchError:
        return ""


def _module_text(
    notebook: Notebook,
    names: Sequence[str],
    packages: Iterable[str],
    lab: str,
    given: str,
    replaced: set[str],
) -> str:
    """Python text of functions with all that they need, as typed, in the notebook's order.

    Args:
        notebook: where they are.
        names: of the functions.
        packages: that they may import.
        lab: "lab03".
        given: package of the given code, relative to the module.
        replaced: functions that come from elsewhere and are left out.
    """
    sources = collect_sources(notebook, names, packages)
    needed = {ast.dump(node) for source in sources.values() for node in ast.parse(source.text).body}
    texts, future = [], []
    for node, typed in written_statements(notebook):
        bound = {getattr(node, "name", "")} | {
            target.id for target in getattr(node, "targets", ()) if isinstance(target, ast.Name)
        }
        if ast.dump(ast.parse(ast.unparse(node)).body[0]) not in needed or bound & replaced:
            continue
        if isinstance(node, ast.ImportFrom) and node.module == "__future__":
            future.append(ast.unparse(node))
            continue
        changed = _Given(lab, given)
        tree = changed.visit(node)
        text = ast.unparse(tree) if changed.found else typed
        if typed.startswith("from given import"):  # as typed, in several lines if it was
            text = typed.replace("from given import", f"from {given}.{lab} import", 1)
        if text not in texts or not isinstance(node, ast.Import | ast.ImportFrom):
            gap = "\n\n" if isinstance(node, ast.FunctionDef | ast.ClassDef) else ""
            texts.append(gap + text)
    return "\n".join([*dict.fromkeys(future), *texts]) + "\n\n"


class _Given(ast.NodeTransformer):
    """Imports of `given` become those of the package's copy, at any depth."""

    def __init__(self, lab: str, package: str) -> None:
        self.lab, self.package, self.found = lab, package, False

    def visit_Import(self, node: ast.Import) -> ast.stmt:
        if all(alias.name != "given" for alias in node.names):
            return node
        self.found = True
        level = len(self.package) - len(self.package.lstrip("."))
        name = next(alias.asname or "given" for alias in node.names if alias.name == "given")
        return ast.ImportFrom(self.package.lstrip("."), [ast.alias(self.lab, name)], level)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.stmt:
        if node.module != "given" or node.level:
            return node
        self.found = True
        level = len(self.package) - len(self.package.lstrip("."))
        return ast.ImportFrom(f"{self.package.lstrip('.')}.{self.lab}", node.names, level)


def _loads(package: Path, one: CheckedLab) -> bool:
    """Whether a module loads, in a process with the limits of `check`."""
    job = SandboxJob(
        text=_LOAD.format(place=str(package.parent.resolve()), package=package.name),
        function="load",
        folder=package,  # without the lab's files around it, as where the package is used
        packages=one.lab.packages,
        seconds=LOAD_S,
        memory_mib=one.lab.memory_mib,
    )
    try:
        with process_worker(job) as worker:
            return bool(worker.call(one.part.module, one.names))
    except (StudentError, RuntimeError):
        return False


_LOAD = """
import importlib
import sys

sys.dont_write_bytecode = True
sys.path.insert(0, {place!r})


def load(module, names):
    loaded = importlib.import_module({package!r} + "." + module)
    return all(callable(getattr(loaded, name)) for name in names)
"""


def _write_cover(package: Path, choices: Sequence[Choice]) -> None:
    """Write `__init__.py`, README.md and the record."""
    modules = [part.module for part in PARTS]
    mine = sum(choice.mine for choice in choices)
    said = f"{mine} of {len(choices)} functions are mine, the others are the kit's"
    (package / "__init__.py").write_text(
        f'"""My FalconWing, one module for each part: {said}."""\n\n'
        "import importlib\n\n"
        f"__all__ = {modules!r}\n\n\n"
        "def __getattr__(name):\n"
        '    """A part, loaded when it is first used."""\n'
        "    if name not in __all__:\n"
        "        raise AttributeError(name)\n"
        '    return importlib.import_module(f"{__name__}.{name}")\n',
        encoding="utf-8",
    )
    record = {"parts": [asdict(part) for part in PARTS], "functions": list(map(asdict, choices))}
    (package / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    rows = [
        f"| `{choice.part}` | `{choice.function}` | "
        f"{'mine' if choice.mine else 'the kit’s: ' + choice.why.replace('|', '/')} |"
        for choice in choices
    ]
    text = [
        "# My FalconWing",
        "",
        f"{said[0].upper()}{said[1:]}. `falconwing labs collect-mine` wrote this folder from my",
        "notebooks; run it again after you changed one. `my_falconwing.renderer` is lab 3's.",
        "",
        "| part | function | whose |",
        "|---|---|---|",
        *rows,
        "",
        "| part | lab | does | the same in the kit |",
        "|---|---|---|---|",
        *(
            f"| `{part.module}` | {int(part.lab[3:])} | {part.what} | {', '.join(part.kit)} |"
            for part in PARTS
        ),
    ]
    (package / "README.md").write_text("\n".join(text) + "\n", encoding="utf-8")
