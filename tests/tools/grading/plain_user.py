"""A plain user: a command's words -> its run by a user without rights or control groups.

As root, in a mount namespace in which that user may read Python and the checkout at their own
paths; any other user is plain already.
"""

import ctypes
import os
import subprocess
import sys
import tempfile
from pathlib import Path

USER = 54322  # without an account
CHECKOUT = Path(__file__).parents[3]
_CLONE_NEWNS, _MS_BIND, _MS_REC, _MS_PRIVATE = 0x20000, 0x1000, 0x4000, 0x40000


def run_as_plain_user(words, seconds):
    """The finished process of a command, with its output as text.

    Args:
        words: Python's arguments; HOME stands for a folder of the user's own.
        seconds: limit.
    """
    root = os.geteuid() == 0
    kept = {name: os.environ[name] for name in ("PATH", "CI") if name in os.environ}
    with tempfile.TemporaryDirectory(prefix="falconwing-plain-") as home:
        if root:
            os.chown(home, USER, USER)
        return subprocess.run(
            [sys.executable, "-B", *(word.replace("HOME", home) for word in words)],
            cwd=CHECKOUT,
            env={**kept, "HOME": home, "TMPDIR": home, "PYTHONPATH": str(CHECKOUT)},
            preexec_fn=_become_plain if root else None,
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )


def _become_plain():
    """In the new process: open closed folders above what is needed, and drop all rights."""
    library = ctypes.CDLL(None, use_errno=True)

    def mount(source, target, kind, flags):
        words = [None if each is None else str(each).encode() for each in (source, target, kind)]
        if library.mount(*words, ctypes.c_ulong(flags), None) != 0:
            raise OSError(ctypes.get_errno(), "mount", str(target))

    if library.unshare(_CLONE_NEWNS) != 0:
        raise OSError(ctypes.get_errno(), "unshare")
    mount(None, "/", None, _MS_REC | _MS_PRIVATE)
    needed = {CHECKOUT.resolve(), Path(sys.base_prefix).resolve(), Path(sys.prefix).resolve()}
    handles = {path: os.open(path, os.O_PATH) for path in needed}
    for path, handle in handles.items():
        for above in reversed(path.parents):
            if above.exists() and not above.stat().st_mode & 1:
                mount("open", above, "tmpfs", 0)
        if not path.exists():
            path.mkdir(parents=True)
            mount(f"/proc/self/fd/{handle}", path, None, _MS_BIND | _MS_REC)
        os.close(handle)
    os.setgroups([])
    os.setresgid(USER, USER, USER)
    os.setresuid(USER, USER, USER)
