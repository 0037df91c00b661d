"""Capture: photos of a hall -> camera poses -> world alignment -> trained scene; packed scenes."""

from falconwing_kit.tools.capture.photo_files import read_photo, read_reconstruction
from falconwing_kit.tools.capture.poses import photos_to_poses
from falconwing_kit.tools.capture.survey.marker import observe_marker
from falconwing_kit.tools.capture.survey.points import MARKER_CORNERS, read_survey
from falconwing_kit.tools.capture.survey.recipe import align_photos

__all__ = [
    "MARKER_CORNERS",
    "align_photos",
    "observe_marker",
    "photos_to_poses",
    "read_photo",
    "read_reconstruction",
    "read_survey",
]
