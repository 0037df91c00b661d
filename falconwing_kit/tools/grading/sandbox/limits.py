"""Resource limits of a sandbox: control groups for processes and memory, and dropped privileges.

Limits that a process sets itself (worker.py) do not bind root, so a grader started by root drops
its privileges before the sandbox starts. Control groups (version 1 or 2) are used where the system
permits their creation; elsewhere system_calls.py leaves a function no memory but its process's own.
"""

import ctypes
import itertools
import os
import signal
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

NOBODY = 54321  # unused user and group number for sandboxes started by root
STAGE = Path("/tmp")  # mount point for staged files, in the new process's mount namespace
_PREFIX = "falconwing-"
_CLONE_NEWNS, _MS_BIND, _MS_REC, _MS_PRIVATE = 0x20000, 0x1000, 0x4000, 0x40000
_numbers = itertools.count(1)


@dataclass(frozen=True)
class ControlGroup:
    """Control groups of one sandbox.

    Attributes:
        folders: one for each available hierarchy; empty where the system forbids it.
    """

    folders: tuple[Path, ...]

    def join(self) -> None:
        """Add the calling process, and with it its children."""
        for folder in self.folders:
            (folder / "cgroup.procs").write_text("0")

    def members(self) -> set[int]:
        """Processes in the group."""
        texts = []
        for folder in self.folders:
            with suppress(OSError):
                texts += (folder / "cgroup.procs").read_text().split()
        return {int(text) for text in texts} - {0}

    def out_of_memory(self) -> bool:
        """Whether the kernel killed a process of the group for its memory."""
        for folder, name in itertools.product(
            self.folders, ("memory.oom_control", "memory.events")
        ):
            with suppress(OSError):
                if any(
                    line.split()[0] == "oom_kill" and int(line.split()[1])
                    for line in _lines(folder / name)
                ):
                    return True
        return False

    def remove(self, seconds: float = 10.0) -> bool:
        """End all processes of the group and remove it; returns whether that succeeded in time."""
        end = time.monotonic() + seconds
        while members := self.members():
            for process in members:
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            if time.monotonic() > end:
                return False
            time.sleep(0.002)
        return all([_remove(folder) for folder in self.folders])


def make_group(processes: int, memory: int) -> ControlGroup:
    """Create the control groups of a sandbox.

    Args:
        processes: limit of processes and threads together.
        memory: limit for all of them, temporary files included [bytes].

    Returns:
        A group with a folder for each available controller, possibly none.
    """
    name = f"{_PREFIX}{os.getpid()}-{next(_numbers)}"
    limits = {
        "pids": {"pids.max": processes},
        "memory": dict.fromkeys(
            ("memory.limit_in_bytes", "memory.memsw.limit_in_bytes", "memory.max"), memory
        )
        | {"memory.swap.max": 0},
    }
    made = []
    for parent, controllers in _parents():
        folder = parent / name
        with suppress(OSError):
            folder.mkdir()
            made.append(folder)
            for file, limit in itertools.chain.from_iterable(
                limits[each].items() for each in controllers
            ):
                if (folder / file).exists():
                    (folder / file).write_text(str(limit))
    return ControlGroup(tuple(made))


def sweep() -> None:
    """Remove the groups of killed graders, with the processes still in them."""
    for parent, _ in _parents():
        for folder in parent.glob(f"{_PREFIX}*-*"):
            owner = folder.name.removeprefix(_PREFIX).split("-")[0]
            if owner.isdigit() and not Path("/proc", owner).exists():
                ControlGroup((folder,)).remove()


def controllers() -> tuple[str, ...]:
    """The available controllers, of "memory" and "pids"."""
    return tuple(sorted(name for _, names in _parents() for name in names))


def resident_bytes(process: int) -> int:
    """Memory of a process and all its descendants together, as far as they can be read [bytes]."""
    total, waiting = 0, [process]
    while waiting:
        place = Path("/proc", str(waiting.pop()))
        pages = " ".join(_lines(place / "statm")).split()
        total += int(pages[1]) * os.sysconf("SC_PAGE_SIZE") if len(pages) > 1 else 0
        for file in place.glob("task/*/children"):
            waiting += map(int, " ".join(_lines(file)).split())
    return total


@lru_cache(maxsize=1)
def _parents() -> tuple[tuple[Path, tuple[str, ...]], ...]:
    """Folders in which groups can be created, with the controllers available there."""
    found: dict[Path, list[str]] = {}
    for name in ("pids", "memory"):
        place = next((place for place in _places(name) if _may_make(place, name)), None)
        if place is not None:
            found.setdefault(place, []).append(name)
    return tuple((place, tuple(names)) for place, names in found.items())


def _places(controller: str) -> Iterator[Path]:
    """Candidate folders for a controller's groups: our own group, and the root."""
    own = {
        line.split(":")[1]: line.split(":", 2)[2].lstrip("/")
        for line in _lines(Path("/proc/self/cgroup"))
    }
    for _, mount, kind, options, *_ in (line.split() for line in _lines(Path("/proc/self/mounts"))):
        if kind == "cgroup" and controller in options.split(","):
            yield Path(mount) / next(
                (path for names, path in own.items() if controller in names.split(",")), ""
            )
            yield Path(mount)
        elif kind == "cgroup2":  # a user's session may own a folder above our own group
            ours = Path(mount) / own.get("", "")
            yield from (Path(mount), ours, *ours.parents[: len(ours.relative_to(mount).parts)])


def _may_make(parent: Path, controller: str) -> bool:
    """Whether a group created there has the controller's files, by a trial."""
    trial = parent / f"{_PREFIX}{os.getpid()}-0"
    with suppress(OSError):  # version 2 delegates a controller only on request
        if controller not in (parent / "cgroup.subtree_control").read_text().split():
            (parent / "cgroup.subtree_control").write_text(f"+{controller}")
    try:
        trial.mkdir()
    except OSError:
        return False
    try:
        return any((trial / f"{controller}.{name}").exists() for name in ("max", "limit_in_bytes"))
    finally:
        _remove(trial)


def make_preexec(group: ControlGroup, staged: Sequence[tuple[Path, Path]]) -> Callable[[], None]:
    """The function to run in a new process before bubblewrap: join the group, drop privileges.

    Args:
        group: its control groups.
        staged: only for root: files and folders to bind-mount under STAGE in the process's mount
            namespace, since it may not reach them without privileges: path, path under STAGE.
    """
    library = ctypes.CDLL(None, use_errno=True)

    def mount(
        source: str | None, target: str, kind: str | None, flags: int, options: str | None = None
    ) -> None:
        words = [
            None if word is None else word.encode() for word in (source, target, kind, options)
        ]
        if library.mount(words[0], words[1], words[2], ctypes.c_ulong(flags), words[3]) != 0:
            raise OSError(ctypes.get_errno(), "mount", target)

    def become() -> None:
        group.join()
        if os.geteuid() != 0:
            return
        if library.unshare(_CLONE_NEWNS) != 0:
            raise OSError(ctypes.get_errno(), "unshare")
        mount(None, "/", None, _MS_REC | _MS_PRIVATE)
        # opened before STAGE is mounted over, so that files below it stay reachable
        handles = [os.open(source, os.O_PATH) for source, _ in staged]
        mount("stage", str(STAGE), "tmpfs", 0, "mode=0755,size=1m")
        for handle, (_, target) in zip(handles, staged, strict=True):
            target.mkdir() if stat.S_ISDIR(os.fstat(handle).st_mode) else target.touch()
            mount(f"/proc/self/fd/{handle}", str(target), None, _MS_BIND | _MS_REC)
            os.close(handle)
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)

    return become


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []


def _remove(folder: Path) -> bool:
    """Remove an empty group, with retries, since the kernel releases it with a delay."""
    for _ in range(200):
        try:
            folder.rmdir()
            return True
        except FileNotFoundError:
            return True
        except OSError:
            time.sleep(0.005)
    return False
