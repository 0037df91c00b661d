"""System calls of a sandbox: what is denied -> a seccomp filter for bubblewrap, as bytes.

A process's own limits bound its memory, but not that of its children, and not memory that belongs
to no process: files in memory, System V segments and queues. Where no control group bounds all of
it together, these are denied. The filter is a program of the kernel's classic BPF [seccomp(2)].
"""

import platform
import struct

_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06  # BPF instructions
_NUMBER, _MACHINE, _FIRST_ARGUMENT = 0, 4, 16  # offsets in the kernel's struct seccomp_data
_ALLOW, _ERROR, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_EPERM, _ENOSYS = 1, 38
_CLONE_THREAD = 0x10000
_FOREIGN = 0x40000000  # numbers from here on are x86's x32, a second set of the same calls
# The kernel's numbers [asm/unistd.h, linux/audit.h]: of the machine; of the calls that get memory
# or a process outside of the limits; of clone, which starts threads too; of clone3.
_MACHINES: dict[str, tuple[int, dict[str, int], dict[str, int], int, int]] = {
    "x86_64": (
        0xC000003E,
        {
            **{"memfd_create": 319, "memfd_secret": 447, "io_uring_setup": 425},
            **{"shmget": 29, "msgget": 68, "mq_open": 240},
        },
        {"fork": 57, "vfork": 58},
        56,
        435,
    ),
    "aarch64": (
        0xC00000B7,
        {
            **{"memfd_create": 279, "memfd_secret": 447, "io_uring_setup": 425},
            **{"shmget": 194, "msgget": 186, "mq_open": 180},
        },
        {},
        220,
        435,
    ),
}


def seccomp_filter(*, processes: bool) -> bytes:
    """The filter for this machine.

    Args:
        processes: new processes may be started; otherwise threads only.

    Returns:
        The program for `bwrap --seccomp`; empty on machines whose numbers are not listed, where
        `probe_sandbox` finds what stays open.
    """
    if platform.machine() not in _MACHINES:
        return b""
    machine, memory, starts, clone, clone3 = _MACHINES[platform.machine()]
    denied = [*memory.values(), *([] if processes else starts.values())]
    program = [
        (_LOAD, 0, 0, _MACHINE),
        (_EQUAL, 1, 0, machine),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER),
        (_AT_LEAST, 0, 1, _FOREIGN),
        (_RETURN, 0, 0, _ERROR | _ENOSYS),
    ]
    for number in denied:
        program += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _ERROR | _EPERM)]
    if not processes:  # clone3 hides its flags from a filter; libraries then use clone
        program += [
            (_EQUAL, 0, 1, clone3),
            (_RETURN, 0, 0, _ERROR | _ENOSYS),
            (_EQUAL, 0, 3, clone),
            (_LOAD, 0, 0, _FIRST_ARGUMENT),
            (_ANY_BIT, 1, 0, _CLONE_THREAD),
            (_RETURN, 0, 0, _ERROR | _EPERM),
        ]
    program.append((_RETURN, 0, 0, _ALLOW))
    return b"".join(struct.pack("=HBBI", *each) for each in program)
