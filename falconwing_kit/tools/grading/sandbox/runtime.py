"""Content of a sandbox: this Python and a lab's libraries -> read-only mounts for bubblewrap.

Works for a system Python, one built in a home folder, and a virtual environment of either: the
sandbox contains the base interpreter, and of the environment only the libraries of the lab.
"""

import importlib.util
import os
import shutil
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.sandbox.limits import STAGE
from falconwing_kit.tools.grading.sandbox.system_calls import seccomp_filter

SANDBOX, PACKAGES, WORK = (  # inside the sandbox
    Path("/sandbox"),
    Path("/sandbox/packages"),
    Path("/sandbox/work"),
)
PYTHON = ("-s", "-P", "-B")  # no user site, no working directory on the path, no bytecode files
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    **{"HOME": "/tmp", "TMPDIR": "/tmp", "LANG": "C.UTF-8", "PYTHONHASHSEED": "0"},
}
TEMPORARY = 64 << 20  # bytes of /tmp, the only writable folder
_TORCH_IMPORTS = (
    "typing_extensions",
    "filelock",
    "sympy",
    "mpmath",
    "networkx",
    "jinja2",
    "markupsafe",
    "fsspec",
)
# dependencies of a library: further folders of its wheel, and libraries that it imports
_BRINGS = {
    "numpy": ("numpy.libs",),
    "scipy": ("scipy.libs",),
    "torch": ("torch.libs", "torchgen", "functorch", "nvidia", "triton", *_TORCH_IMPORTS),
}


@dataclass(frozen=True)
class Runtime:
    """The Python of a sandbox.

    Attributes:
        python: path of the interpreter, the same inside and outside.
        mounts: read-only: path outside, path inside.
        links: symbolic links inside: target, path.
        emptied: folders inside that are hidden by empty ones, since they hold other libraries.
    """

    python: Path
    mounts: tuple[tuple[Path, Path], ...]
    links: tuple[tuple[str, Path], ...]
    emptied: tuple[Path, ...]


@dataclass(frozen=True)
class SandboxCommand:
    """How to start a sandbox.

    Attributes:
        words: bubblewrap's command line, without the options: a function can read it.
        descriptors: open files with the options and the filter, to be passed and then closed.
        staged: files that a grader run by root mounts for the sandbox's user, see
            `limits.make_preexec`: path, path under STAGE.
    """

    words: tuple[str, ...]
    descriptors: tuple[int, ...]
    staged: tuple[tuple[Path, Path], ...]


def sandbox_command(
    packages: tuple[str, ...],
    own: Mapping[Path, Path],
    files: Mapping[int, Path],
    script: str,
    *,
    processes: bool = False,
) -> SandboxCommand:
    """bubblewrap's command line for a sandbox that runs a script.

    Args:
        packages: of "numpy", "scipy", "torch".
        own: further read-only mounts: path outside, path inside; missing ones are skipped.
        files: open files to copy in: descriptor, path inside.
        script: name of a file in SANDBOX.
        processes: the script may start processes.

    Raises:
        InputError: there is no bubblewrap, or a library is not installed.
    """
    program = shutil.which("bwrap")
    if program is None:
        raise InputError(
            "bwrap: expected bubblewrap for the box, found none; Debian or Ubuntu: "
            "apt install bubblewrap"
        )
    python = find_runtime(packages)
    words = [*_WALLS]
    staged: list[tuple[Path, Path]] = []
    for source, target in (
        *python.mounts,
        *((here, there) for here, there in own.items() if here.exists()),
    ):
        if (
            os.geteuid() == 0
            and not source.is_relative_to("/usr")
            and not source.is_relative_to("/etc")
        ):
            staged.append((source, STAGE / str(len(staged))))
            source = staged[-1][1]
        words += ["--ro-bind", str(source), str(target)]
    for link, path in python.links:
        words += ["--symlink", link, str(path)]
    for path in python.emptied:
        words += ["--size", "4096", "--tmpfs", str(path), "--remount-ro", str(path)]
    for number, path in files.items():
        words += ["--ro-bind-data", str(number), str(path)]
    words += ["--proc", "/proc", "--dev", "/dev", "--remount-ro", "/dev"]
    words += [
        "--size",
        str(TEMPORARY),
        "--tmpfs",
        "/tmp",
        "--remount-ro",
        "/",
        "--chdir",
        str(WORK),
    ]
    for name, value in ENVIRONMENT.items():
        words += ["--setenv", name, value]
    denied = seccomp_filter(processes=processes)
    descriptors = [_open_file(denied)] if denied else []
    words += ["--seccomp", str(descriptors[0])] if denied else []
    descriptors.append(_open_file("".join(f"{word}\0" for word in words).encode()))
    run = [str(python.python), *PYTHON, "-S", str(SANDBOX / script), str(PACKAGES), str(WORK)]
    return SandboxCommand(
        (program, "--args", str(descriptors[-1]), "--", *run), tuple(descriptors), tuple(staged)
    )


def _open_file(content: bytes) -> int:
    """Descriptor of a file in memory, at its beginning."""
    descriptor = os.memfd_create("sandbox")
    os.pwrite(descriptor, content, 0)
    return descriptor


_WALLS = (
    *(
        "--unshare-all",
        "--unshare-user",
        "--disable-userns",
        "--uid",
        "1000",
        "--gid",
        "1000",
        "--cap-drop",
        "ALL",
    ),
    *(
        "--clearenv",
        "--new-session",
        "--die-with-parent",
        "--hostname",
        "sandbox",
        "--dir",
        str(WORK),
    ),
)


@lru_cache(maxsize=8)
def find_runtime(packages: tuple[str, ...]) -> Runtime:
    """This Python with some of its libraries.

    Args:
        packages: of "numpy", "scipy", "torch"; NumPy is always there.

    Raises:
        InputError: a library is not installed.
    """
    python = Path(getattr(sys, "_base_executable", sys.executable)).resolve()
    folders = list(_library_folders())
    links = [(os.readlink(path), path) for path in _SYSTEM if path.is_symlink()]
    installed = [mount for name in dict.fromkeys(("numpy", *packages)) for mount in _package(name)]
    emptied = [
        found
        for folder in folders
        for pattern in ("site-packages", "dist-packages")
        for found in (*folder.glob(pattern), *folder.glob(f"python3*/{pattern}"))
    ]
    return Runtime(
        python,
        ((python, python), *((f, f) for f in folders), *installed),
        tuple(links),
        tuple(emptied),
    )


_SYSTEM = (Path("/lib"), Path("/lib64"), Path("/usr/lib64"))


def _library_folders() -> Iterator[Path]:
    """Folders of the standard library and the shared libraries, without nested ones."""
    prefix, standard = Path(sys.base_prefix).resolve(), Path(os.__file__).resolve().parent
    several = sysconfig.get_config_var("MULTIARCH") or ""
    system = [folder / several for folder in (Path("/usr/lib"), Path("/lib"))] if several else []
    if not any(folder.is_dir() for folder in system):
        system = [Path("/usr/lib")]
    wanted = [*system, Path("/usr/lib64"), Path("/lib64"), Path("/etc/alternatives"), standard]
    wanted += [] if prefix == Path("/usr") else [prefix / "lib"]
    wanted += Path("/lib").glob(
        "ld-linux*"
    )  # the loader, where it does not stand in a folder of its own
    found = sorted({folder.resolve() for folder in wanted if folder.exists()})
    yield from (folder for folder in found if not any(other in folder.parents for other in found))


def _package(name: str) -> Iterator[tuple[Path, Path]]:
    """Mounts of a library's folder and of its dependencies, beside each other."""
    home = _place(name)
    if home is None:
        raise InputError(
            f"{name}: expected it installed, since the lab's functions may use it; "
            "`falconwing doctor` helps"
        )
    others = [home.parent / each if "." in each else _place(each) for each in _BRINGS.get(name, ())]
    for place in (home, *others):
        if place is not None and place.exists():
            yield place.resolve(), PACKAGES / place.name


def _place(name: str) -> Path | None:
    """Path of a module, without importing it; None if not installed."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        return None
    folders: Sequence[str] = list(spec.submodule_search_locations or ())
    return Path(folders[0]) if folders else Path(str(spec.origin))
