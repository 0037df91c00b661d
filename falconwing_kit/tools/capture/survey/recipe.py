"""Full alignment: reconstruction, photos and survey -> baseline, marker and best alignment.

1. OpenCV detects the marker in every photo. Its corners give a first alignment.
2. The marker's sides are fitted as lines near their predicted places. OpenCV's corners lie up to a
   third of a pixel inside the square, which would make the hall one per cent too large.
3. Flat faces of the survey (the pad) are searched where the alignment's uncertainty allows; their
   corners improve the alignment. Repeated until no more are found.
"""

from collections.abc import Callable
from dataclasses import dataclass

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.tools.capture.align import Alignment, align, align_by_marker_poses, triangulate
from falconwing_kit.tools.capture.photo_files import Reconstruction
from falconwing_kit.tools.capture.survey.faces import observe_faces
from falconwing_kit.tools.capture.survey.marker import DICTIONARY, MARKER_ID, observe_marker
from falconwing_kit.tools.capture.survey.points import MARKER_CORNERS, PointObservations, Survey

MAX_ROUNDS = 5


@dataclass(frozen=True)
class Alignments:
    """The alignments of one set of photos by different methods."""

    baseline: Alignment | None  # by the marker's pose in each photo; None without the marker
    marker: Alignment | None  # by the marker's corners
    best: Alignment  # by every surveyed point that was found or clicked
    observations: PointObservations  # of the best alignment


def align_photos(
    reconstruction: Reconstruction,
    survey: Survey,
    marker_id: int = MARKER_ID,
    dictionary: str = DICTIONARY,
    clicks: PointObservations | None = None,
    progress: Callable[[str, int, int], None] = lambda step, done, total: None,
) -> Alignments:
    """Align a reconstruction by the surveyed points that its photos show.

    Args:
        reconstruction: not aligned.
        survey: with the marker's four corners, and flat faces of four points where there are any.
        dictionary: of the marker, its name in OpenCV.
        clicks: manual observations of surveyed points, used in addition. With three or more points
            clicked, the photos need not show a marker.
        progress: called with step, done and total.

    Raises:
        FileNotFoundError: a photo is missing.
        InputError: the marker is not found and fewer than three points were clicked, or the
            reconstruction is aligned already.
    """
    clicks = PointObservations.join([]) if clicks is None else clicks
    points, total = survey.select("align"), len(reconstruction)
    has_marker = set(MARKER_CORNERS) <= set(points.names)
    baseline = marker = None
    found = PointObservations.join([])
    if has_marker:
        try:
            rough = observe_marker(
                reconstruction, marker_id, dictionary, _progress_counter(progress, "marker", total)
            )
        except InputError:
            if len(set(clicks.names)) < 3:
                raise
        else:
            baseline = _none_on_error(lambda: align_by_marker_poses(reconstruction, points, rough))
            found = _refine_corners(
                reconstruction, points, rough, _progress_counter(progress, "marker's sides", total)
            )
            marker = align(reconstruction, points, found)
    elif len(set(clicks.names)) < 3:
        raise InputError(
            "survey: expected the marker's four corners of use align, or three clicked points; "
            "add them"
        )
    best, faces = align(reconstruction, points, found + clicks), PointObservations.join([])
    targets = [
        (names, points.places(names))
        for names in points.faces()
        if not set(names) & set(clicks.names)
    ]
    for turn in range(MAX_ROUNDS if targets else 0):
        seen = observe_faces(
            reconstruction,
            best,
            targets,
            progress=_progress_counter(progress, f"faces, turn {turn + 1}", total),
        )
        if len(seen) == len(faces):
            break
        faces = seen
        best = align(reconstruction, points, found + clicks + faces)
    return Alignments(baseline, marker, best, found + clicks + faces)


def check_points(
    best: Alignment,
    reconstruction: Reconstruction,
    survey: Survey,
    clicks: PointObservations | None = None,
) -> dict[str, Array]:
    """Triangulate the survey's check points, on faces located by an alignment.

    An edge is the strongest colour step near its place, since most such faces are posters or
    windows.

    Args:
        best: alignment that predicts the faces' places; otherwise unused.
        reconstruction: not aligned.
        survey: its points of use "check", which were not used for the alignment.
        clicks: manual observations; clicked points are not searched.

    Returns:
        By name: (3,) in the reconstruction's frame, for every point with two or more consistent
            observations.

    Raises:
        FileNotFoundError: a photo is missing.
    """
    points, clicks = (
        survey.select("check"),
        PointObservations.join([]) if clicks is None else clicks,
    )
    faces = [
        (names, points.places(names))
        for names in points.faces()
        if not set(names) & set(clicks.names)
    ]
    seen = (
        observe_faces(reconstruction, best, faces, plain=False)
        if faces
        else PointObservations.join([])
    )
    found = triangulate(reconstruction, seen + clicks)
    return {name: place for name, place in found.items() if name in points.names}


def _refine_corners(
    reconstruction: Reconstruction,
    points: Survey,
    rough: PointObservations,
    progress: Callable[[], None],
) -> PointObservations:
    """Marker corners as intersections of its sides, or OpenCV's where too few photos show them."""
    first = align(reconstruction, points, rough)
    sharp = observe_faces(
        reconstruction, first, [(MARKER_CORNERS, points.places(MARKER_CORNERS))], progress=progress
    )
    enough = all(sharp.names.count(name) >= 3 for name in MARKER_CORNERS)
    return sharp if enough else rough


def _none_on_error(make: Callable[[], Alignment]) -> Alignment | None:
    try:
        return make()
    except InputError:
        return None  # the baseline is only shown for comparison


def _progress_counter(
    progress: Callable[[str, int, int], None], step: str, total: int
) -> Callable[[], None]:
    """A callback that reports the number of its calls."""
    done = [0]

    def one_more() -> None:
        done[0] += 1
        progress(step, done[0], total)

    return one_more
