"""The whole alignment: a reconstruction, its photos and a survey -> the baseline that fails and the
ones that work.

1. OpenCV finds the marker in every photo. Its corners alone give a first alignment.
2. The marker's sides are fitted as lines where that alignment expects them. OpenCV's own corners
   lie up to a third of a pixel inside the square, which makes a hall measured by an 80 cm marker
   one per cent too large.
3. Flat faces of the survey (the pad) are looked for wherever the alignment is sure enough to tell
   where. What is found makes it surer, so more is found the next time.
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
    """What each recipe makes of the same photos."""

    baseline: (
        Alignment | None
    )  # the marker's pose in each photo; None where the marker was not used
    marker: Alignment | None  # the marker's corners
    best: Alignment  # every surveyed point that was found or clicked
    observations: PointObservations  # what the best one used


def align_photos(
    reconstruction: Reconstruction,
    survey: Survey,
    marker_id: int = MARKER_ID,
    dictionary: str = DICTIONARY,
    clicks: PointObservations | None = None,
    progress: Callable[[str, int, int], None] = lambda step, done, total: None,
) -> Alignments:
    """Align a reconstruction by what its photos show of the survey.

    Args:
        reconstruction: not aligned.
        survey: with the marker's four corners, and flat faces of four points where there are any.
        marker_id: the marker's number.
        dictionary: its dictionary's name in OpenCV.
        clicks: where somebody clicked surveyed points; they are used beside what is found. With
            three or more points clicked, the photos need not show a marker.
        progress: called with step, done and total.

    Returns:
        The alignments.

    Raises:
        FileNotFoundError: a photo is gone.
        InputError: the marker is not found and too little was clicked, or the reconstruction is
            aligned already.
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
    """Points kept for checking, where photos show them: their faces are looked for where an
    alignment expects them.

    Edges are the strongest steps near their place, since most such faces are posters or windows.

    Args:
        best: the surest alignment; it only says where to look.
        reconstruction: not aligned.
        survey: whose points of use "check" nothing was aligned by.
        clicks: where somebody clicked surveyed points; what was clicked is not looked for.

    Returns:
        By name: (3,) in the reconstruction's frame, for every point that two or more photos agree
            on.

    Raises:
        FileNotFoundError: a photo is gone.
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
    """The marker's corners where its sides meet; OpenCV's corners where too few photos show the
    sides well.
    """
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
    """A function that counts its calls into a progress."""
    done = [0]

    def one_more() -> None:
        done[0] += 1
        progress(step, done[0], total)

    return one_more
