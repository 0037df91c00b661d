"""24 photos of the path-traced hall: from files to an alignment, once for all tests that look at
the result.
"""

import shutil
import tempfile
from functools import cache
from pathlib import Path

from falconwing_kit.tools.capture.photo_files import Reconstruction
from falconwing_kit.tools.capture.poses import photos_to_poses
from falconwing_kit.tools.capture.survey.points import Survey, read_survey
from falconwing_kit.tools.capture.survey.recipe import Alignments, align_photos

FOLDER = Path(__file__).parents[1] / "data" / "hall24"


@cache
def reconstruction() -> Reconstruction:
    """Poses of the photos, not aligned."""
    out = Path(tempfile.mkdtemp())
    try:
        return photos_to_poses(FOLDER / "photos", out)
    finally:
        shutil.rmtree(out)


@cache
def survey() -> Survey:
    """The tape's measurements."""
    return read_survey(FOLDER / "survey.csv")


@cache
def alignments() -> Alignments:
    """Every recipe on the photos."""
    return align_photos(reconstruction(), survey())
