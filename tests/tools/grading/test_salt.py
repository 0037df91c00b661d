"""The course's secret is the kit's own, stays its owner's, and is slow to guess."""

import math
import os
import stat
import time

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli.grade import Grade
from falconwing_kit.tools.cli.labs import Release
from falconwing_kit.tools.cli.report import Report
from falconwing_kit.tools.grading.salt import SALT_FILE, course_key, stretch
from tests.tools.grading.small_lab import write_small_lab

SALT = "a secret of ours, long enough"


def test_the_kit_draws_a_secret_once(tmp_path):
    """128 bit: 32 hexadecimal digits, others for another course, readable by the owner only."""
    keys = [course_key("", tmp_path / name, make=True) for name in ("one", "one", "two")]
    assert keys[0] == keys[1] != keys[2]
    secret = (tmp_path / "one" / SALT_FILE).read_text().strip()
    assert len(secret) * math.log2(16) >= 128 and int(secret, 16) > 0
    assert secret not in keys[0]
    if os.name == "posix":
        assert stat.S_IMODE((tmp_path / "one" / SALT_FILE).stat().st_mode) == 0o600


@pytest.mark.alone
def test_a_guess_takes_a_while():
    """A plain SHA-256 of each constant takes some 10 us; 50 ms are asked for, 150 ms usual."""
    begin = time.process_time()
    stretch("correct horse battery staple")
    assert time.process_time() - begin > 0.05


@pytest.mark.parametrize("by", ["salt", "course"])
def test_handed_out_numbers_are_those_of_the_stretched_secret(tmp_path, by):
    """What is handed out depends on the key, so a guess of the secret must be stretched to be
    confirmed: the small lab writes down the key that it drew from.
    """
    write_small_lab(tmp_path)
    (tmp_path / "roster.csv").write_text("student\nann\n")
    course = tmp_path / "course" if by == "course" else None
    typed = SALT if by == "salt" else ""
    release = Release(
        tmp_path / "out",
        salt=typed,
        course=course,
        roster=tmp_path / "roster.csv",
        labs=tmp_path,
        json=True,
    )
    assert release.run() == 0
    secret = typed or (tmp_path / "course" / SALT_FILE).read_text().strip()
    mine = (tmp_path / "out" / "handouts" / "ann" / "lab01_small" / "mine.txt").read_text()
    assert mine == f"ann {stretch(secret)}" and secret not in mine


def test_what_cannot_be_a_secret_is_refused(tmp_path):
    """Short, both, none, or lost: `grade` and `report` never make one."""
    (tmp_path / SALT_FILE).write_text("2027\n")
    with pytest.raises(InputError, match="expected at least 16 characters"):
        course_key("", tmp_path)
    with pytest.raises(InputError, match="expected at least 16 characters"):
        course_key("2027", None, make=True)
    with pytest.raises(InputError, match="got both"):
        course_key(SALT, tmp_path)
    empty = tmp_path / "empty"
    for verb in (Grade, Report):
        with pytest.raises(InputError, match="expected the course's secret, found none"):
            verb("lab01", tmp_path, tmp_path / "out", course=empty).run()
    assert not empty.exists() and course_key("", None) == ""
