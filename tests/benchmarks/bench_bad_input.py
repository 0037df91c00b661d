"""Bad input at every door: damaged files of many kinds given to every option that takes a file.

    python -m pytest -m benchmark -s tests/benchmarks/bench_bad_input.py

Every case must end with exit code 2 and one sentence: no traceback, no hang, no other exit. The
same cases run in CI in part (tests/tools/cli/test_bad_input.py).
"""

import resource
import time
from pathlib import Path

import pytest

from tests.tools.cli.bad_input import CASES, DAMAGED, SLOTS, fault, write_damaged

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]


def test_every_file_at_every_door(tmp_path: Path):
    """The whole product, one after the other in this process; the slowest are printed."""
    files = write_damaged(tmp_path)
    faults, slow = [], []
    for slot, name in CASES:
        begin = time.perf_counter()
        found = fault(slot, files[name], tmp_path)
        seconds = time.perf_counter() - begin
        if found:
            faults.append(f"{slot} < {name}: {found}")
        slow.append((seconds, f"{slot} < {name}"))
    print(f"\n{len(CASES)} cases ({len(SLOTS)} doors, {len(DAMAGED)} files): {len(faults)} faults")
    for line in faults:
        print(line)
    for seconds, line in sorted(slow)[-5:]:
        print(f"{seconds:6.2f} s  {line}")
    print(f"memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10} MiB at most")
    assert not faults
