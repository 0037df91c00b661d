# %% [markdown]
# # Lab 6: Pose from images
# **Where was the camera? And where is the world?**
#
# ![Photos from above, placed metres wrong by the first recipe and in their true places by the last; errors of all recipes as bars](goal.webp)
#
# *What you will have at the end (open course).*
#
# The paper's hall has no motion capture. Its world frame comes from one printed marker, 80 cm wide, seen in photos.
# This lab rebuilds that step. The recipe as printed puts cameras metres away. You will see why, and correct it.
#
# **You will be able to**
# - compute the camera's pose from the four corners of a square,
# - fit the similarity between two sets of points, with weights,
# - separate outliers from good measurements without ground truth,
# - triangulate a point from many views, and say how errors grow with distance.
#
# **Time** about 3 hours. **Before** Lab 2 (rotations, pinhole camera); singular values from linear algebra. **Paper**
# *Photorealistic Simulation via Gaussian Splatting*, paragraph *Data Collection and Calibration*; *Hybrid State
# Estimation*.

# %%
PARTS = "kit"  # "mine": what you wrote, after `falconwing labs collect-mine` in the folder above

import matplotlib.pyplot as plt
import numpy as np
from given import (
    COHORT,
    MARKER_SIZE,
    T_WORLD_MARKER,
    K,
    draw_crops,
    draw_distance,
    draw_hall,
    homography,
    marker_square,
    polish,
    read_photos,
)

from falconwing_kit.tools.grading import check, load_parts, whose

parts = load_parts(PARTS) if PARTS == "mine" else None
print("your course:", COHORT)
print(whose(parts, "camera"))  # your lab 2 projects the corners in `polish`
photos = read_photos()
print(f"{len(photos['p_sfm'])} photos, {len(photos['shows'])} of them show the marker")

# %%
from given import moving_photos

from falconwing_kit.tools.grading import borrow, keep_going

keep_going()  # a missing function stops only the cells that need it
moving_photos()

# %% [markdown]
# *In words: left, the hall from above, with a line from the camera of one photo to the marker; right, the marker's four corners
# in that photo. Photo by photo the camera is nearer, and the square grows from some 15 px to more than 100 px.*

# %% [markdown]
# The hall is **path-traced**: a renderer that follows light rays made the photos, in place of a real hall. COLMAP-like
# *structure from motion* (SfM) found where each photo was taken, from the photos alone. But it cannot recover the unit of
# length, nor where up is, nor where the marker is. Its frame "sfm" is an arbitrary one.
#
# The marker gives the tie to the world. OpenCV found its corners in 72 photos, to about 0.3 px.

# %%
draw_crops()
plt.show()

# %% [markdown]
# *In words: the same marker from 3.0 m, more than 100 px wide and sharp, and from 21.7 m, about 15 px wide and
# blurred.*
#
# ## 1 One photo, one pose
# **Marker axes**: x to the right of who looks at the marker, y up, z out of it. **Camera axes**: x right, y down, z
# forward. A point of the marker's plane, $(x, y, 0)$, appears at the pixel $(u, v)$:
#
# $$\lambda \begin{pmatrix} u \\ v \\ 1 \end{pmatrix} = K \,\big(\, r_1 \; r_2 \; t \,\big)
# \begin{pmatrix} x \\ y \\ 1 \end{pmatrix}$$
#
# $r_1, r_2$ are the first two columns of $R$ (camera from marker), $t$ is the marker's centre in the camera [m]. So the
# *homography* $H$ from plane to image is $K (r_1\, r_2\, t)$ up to a factor. `homography` gives you $H$. Then:
#
# 1. $A = K^{-1} H$, with columns $a_1, a_2, a_3$.
# 2. The factor: $r_1$ and $r_2$ have length 1, so divide $A$ by the mean of $|a_1|$ and $|a_2|$.
# 3. $t = a_3$, and the third column of $R$ is $a_1 \times a_2$.
# 4. With noise $(a_1\; a_2\; a_1{\times}a_2)$ is not quite a rotation. The nearest one is $U V^\top$, from its singular
#    value decomposition $U S V^\top$.
# 5. This maps marker to camera. The camera's pose in the marker's axes is the inverse.
#
# Write `marker_pose`.


# %% exercise="marker_pose"
def marker_pose(corners_px, K, size):
    """Pose of a camera that sees the marker. Use marker_square(size) and homography(xy, uv).

    Args:
        corners_px: (4, 2) pixels (u, v) of the corners: top left, top right, bottom right,
            bottom left.
        K: (3, 3) matrix of the lens [px].
        size: side of the square [m].

    Returns:
        T_marker_camera (4, 4): the columns of its rotation are the camera's axes, its last column
        the camera's place [m], both in marker axes.
    """
    # BEGIN SOLUTION
    A = np.linalg.inv(K) @ homography(marker_square(size), corners_px)
    A = A / (0.5 * np.linalg.norm(A[:, 0]) + 0.5 * np.linalg.norm(A[:, 1]))
    U, _, Vt = np.linalg.svd(np.column_stack([A[:, 0], A[:, 1], np.cross(A[:, 0], A[:, 1])]))
    R_camera_marker, p_camera_marker = U @ Vt, A[:, 2]
    T_marker_camera = np.eye(4)
    T_marker_camera[:3, :3] = R_camera_marker.T
    T_marker_camera[:3, 3] = -R_camera_marker.T @ p_camera_marker
    return T_marker_camera
    # END SOLUTION


# %% check="marker_pose"
check(marker_pose)

# %% [markdown]
# Now do it for all 72 photos. `polish` takes your pose as a start and moves the camera until the corners fit best, as
# OpenCV does.

# %%
shows, p_world, p_sfm = photos["shows"], photos["p_world"], photos["p_sfm"]


def camera_places(polished):
    """Where your marker_pose puts the 72 cameras in the world, (72, 3) [m]."""
    poses = []
    for corners_px in photos["corners_px"]:
        T_marker_camera = marker_pose(corners_px, K, MARKER_SIZE)
        poses.append(
            polish(T_marker_camera, corners_px, parts=parts) if polished else T_marker_camera
        )
    return np.array([T_WORLD_MARKER @ T for T in poses])[:, :3, 3]


# %% [markdown]
# The reference for the error is the kit's own alignment, by marker *and* landing pad; it is known to about 3 cm.

# %% figure="distance"
distance = np.linalg.norm(p_world[shows] - T_WORLD_MARKER[:3, 3], axis=1)
rough, polished = camera_places(False) - p_world[shows], camera_places(True) - p_world[shows]
draw_distance(distance, np.linalg.norm(rough, axis=1), np.linalg.norm(polished, axis=1))
plt.show()

# %% [markdown]
# *In words: on logarithmic axes both errors rise steeply with distance. Crosses (homography) follow the line of Z³ and
# end above it, at 20 m. Circles (polished) begin near 3 cm at 3 m and stay between the lines of Z² and Z³, but some
# jump far up, most of them beyond 14 m.*
#
# Why so steep? Let $f$ be the focal length [px], $L$ the marker's side [m], $Z$ the distance [m], $\sigma$ a corner's
# noise [px].
# - **Along the view.** The marker appears $s = f L / Z$ wide. So $dZ = Z^2\, ds / (f L)$: the error grows as $Z^2$.
# - **Across it.** Where the camera is to the side follows from the marker's *tilt*. Seen nearly straight on, a small
#   tilt $\theta$ shows only in this: one edge is nearer by $L \sin\theta$, so it appears longer, by
#   $f L^2 \sin\theta / Z^2$. So $d\theta \approx Z^2 \sigma / (f L^2)$, and $Z\, d\theta$ to the side: $Z^3$.
#
# (Seen from aside, the marker also looks narrower, which shows the tilt better: then it is $Z^2$ again. The photos are
# a mixture.)
#
# When noise hides the longer edge, tilt $+\theta$ and $-\theta$ give the same image. The square then has **two poses**
# (pose ambiguity), and the
# best fit may be the wrong one. That is the jump.
#
# **Question on the figure.** From which distance on would you not trust a single photo, and why?

# %% [markdown] answer="distance_reading"
# Beyond 6 to 10 m. To 8 m the polished places are good to 0.1 to 0.3 m, but near 6 m two of them have jumped to 0.8 m:
# the other pose. Beyond 14 m they are 0.5 to 21 m off. The slope is between Z² and Z³, so twice the distance costs
# four to eight times the error, and one photo hardly shows a jump. Without polishing the errors grow as Z³ all the way.

# %% [markdown]
# ## 2 The paper's recipe
# Now tie the frames together. Each photo has a place by SfM and one by the marker. The paper fits "the rigid transform
# between COLMAP and world frames via the Kabsch-Umeyama algorithm". SfM does not know the scale, so it must be a
# **similarity**:
#
# $$p_\mathrm{to} = s\, R\, p_\mathrm{from} + t$$
#
# Least squares with weights $w_i$ has a closed solution [Kabsch 1976, Umeyama 1991]:
# - $\bar a, \bar b$: the weighted means of both sets; $a_i, b_i$: the points minus their mean.
# - $M = \sum_i w_i\, b_i a_i^\top = U S V^\top$ (singular values), $D = \mathrm{diag}(1, 1, \det(U V^\top))$.
# - $R = U D V^\top$, $\;s = \mathrm{trace}(S D) / \sum_i w_i |a_i|^2$, $\;t = \bar b - s R \bar a$.
#
# $D$ keeps $R$ a rotation where noise or a flat set of points would make it a mirror.
#
# Write `fit_similarity`.


# %% exercise="fit_similarity"
def fit_similarity(p_from, p_to, weights):
    """The similarity that maps points onto others with the least weighted squares.

    Args:
        p_from: (N, 3) points.
        p_to: (N, 3) where they should be.
        weights: (N,) how much each pair counts, 0 or more; they need not sum to 1.

    Returns:
        (scale, R, t): a number, (3, 3) and (3,), so that p_to = scale R p_from + t.
    """
    # BEGIN SOLUTION
    w = weights / np.sum(weights)
    mean_from, mean_to = w @ p_from, w @ p_to
    a, b = p_from - mean_from, p_to - mean_to
    U, S, Vt = np.linalg.svd((w[:, None] * b).T @ a)
    D = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
    R = U @ D @ Vt
    scale = np.sum(S * np.diag(D)) / np.sum(w * np.sum(a**2, axis=1))
    return scale, R, mean_to - scale * R @ mean_from
    # END SOLUTION


# %% check="fit_similarity"
check(fit_similarity)

# %%
recipes = {}  # by name, a function that gives a similarity
placed = {}  # by name, where it puts the photos
all_alike = np.ones(len(shows))


def place_all(recipe):
    """Where a recipe puts all photos (230, 3) [m]."""
    scale, R, t = recipes[recipe]()
    return scale * p_sfm @ R.T + t


def report(recipe):
    """Place all photos by a recipe, keep their places, and print their error."""
    placed[recipe] = place_all(recipe)
    off = np.linalg.norm(placed[recipe] - p_world, axis=1)
    print(f"{recipe}: photos are off by {off.mean():.2f} m on average, {off.max():.2f} m at most")


recipes["homography, all"] = lambda: fit_similarity(p_sfm[shows], camera_places(False), all_alike)
recipes["polished, all"] = lambda: fit_similarity(p_sfm[shows], camera_places(True), all_alike)
for recipe in recipes:
    report(recipe)
print(f"metres per unit of SfM: {recipes['polished, all']()[0]:.3f}")

# %% [markdown]
# Metres. A splat scene aligned like this puts the landing pad where there is none. Two remedies follow: reject outliers,
# or use the marker in a better way.
#
# ## 3 Leave out the outliers
# Least squares is not robust: one camera that is 20 m off dominates the sum. A **median** does not depend on how far off
# the worst half is. So [least median of squares, Rousseeuw 1984]:
#
# - Draw many small sets of photos, fit a similarity to each: the candidates. Some sets hold good photos only.
# - For each candidate compute the *miss* of every photo, $|s R p_\mathrm{from} + t - p_\mathrm{to}|$.
# - The best candidate is the one whose **median miss** is smallest.
# - Keep the photos whose miss with it is at most `COHORT["gate"]` times that median.
#
# Write `reject_outliers`.


# %% exercise="reject_outliers"
def reject_outliers(p_from, p_to, candidates):
    """Which pairs to keep, by the least median of misses. Use COHORT["gate"].

    Args:
        p_from: (N, 3) points.
        p_to: (N, 3) where they should be; some are wrong.
        candidates: list of similarities (scale, R, t).

    Returns:
        (best, keep): the number of the best candidate in the list, and (N,) booleans, True for
        pairs to keep.
    """
    # BEGIN SOLUTION
    off = np.array([scale * p_from @ R.T + t - p_to for scale, R, t in candidates])
    misses = np.linalg.norm(off, axis=2)
    medians = np.median(misses, axis=1)
    best = int(np.argmin(medians))
    keep = misses[best] <= COHORT["gate"] * medians[best]
    return best, keep
    # END SOLUTION


# %% check="reject_outliers"
check(reject_outliers)


# %%
def without_outliers():
    """The similarity of photos that agree with the best of 300 candidates of four photos each."""
    rng, p_marker = np.random.default_rng(0), camera_places(True)
    sets = [rng.choice(len(shows), 4, replace=False) for _ in range(300)]
    candidates = [fit_similarity(p_sfm[shows[few]], p_marker[few], np.ones(4)) for few in sets]
    _, keep = reject_outliers(p_sfm[shows], p_marker, candidates)
    print(f"kept {keep.sum()} of {len(keep)} photos")
    return fit_similarity(p_sfm[shows], p_marker, 1.0 * keep)


recipes["polished, outliers out"] = without_outliers
report("polished, outliers out")

# %% [markdown]
# Better by far, without knowing the truth. But keeping or dropping is crude: a photo from 12 m is worse than one from
# 3 m, and better than none. Least squares is at its best when each weight is $1 / \sigma_i^2$. You know how $\sigma$
# grows with distance.


# %%
def weighted():
    """The similarity of all 72 photos, weighted by their distance Z to the marker."""
    p_marker = camera_places(True)
    Z = np.linalg.norm(p_marker - T_WORLD_MARKER[:3, 3], axis=1)
    return fit_similarity(p_sfm[shows], p_marker, 1.0 / Z**6)


recipes["polished, weights 1/Z⁶"] = weighted
report("polished, weights 1/Z⁶")

# %% [markdown]
# ## 4 Use the marker in a better way
# A single photo hardly constrains its *tilt*. But SfM determines it well, from thousands of points. So use of the marker
# only what it measures well: **where its corners appear**. A corner that appears at a pixel lies on a ray. Rays from many
# photos meet in the corner, in the frame of SfM.
#
# Ray $i$ starts at the camera $c_i$ and has the unit direction $d_i$. A point $p$ misses it by $|(I - d_i d_i^\top)(p -
# c_i)|$. The least weighted squares of these misses is a linear equation for $p$:
#
# $$\Big(\sum_i w_i (I - d_i d_i^\top)\Big)\, p = \sum_i w_i (I - d_i d_i^\top)\, c_i$$
#
# Write `triangulate`. Note that the directions you get are not unit vectors.


# %% exercise="triangulate"
def triangulate(centres, rays, weights):
    """The point next to all rays.

    Args:
        centres: (N, 3) where the rays begin.
        rays: (N, 3) their directions, of any length above 0.
        weights: (N,) how much each ray counts.

    Returns:
        (p, misses): the point (3,), and (N,) its distances from the rays, in the unit of the
        centres.
    """
    # BEGIN SOLUTION
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    left = np.sum(weights[:, None, None] * across, axis=0)
    right = np.sum(weights[:, None] * np.einsum("nij,nj->ni", across, centres), axis=0)
    p = np.linalg.solve(left, right)
    return p, np.linalg.norm(np.einsum("nij,nj->ni", across, p - centres), axis=1)
    # END SOLUTION


# %% check="triangulate"
check(triangulate)

# %% [markdown]
# First all rays with equal weights, then again with the weight $1/Z^2$: a ray is known to an *angle*, so its miss grows
# as $Z$. The
# four corners in the frame of SfM, and the four corners of the printed marker, give the similarity.

# %%
centres, R_sfm_camera = p_sfm[shows], photos["R_sfm_camera"][shows]
ones = np.ones((len(shows), 4, 1))
pixels = np.concatenate([photos["corners_px"], ones], axis=2)  # (n, 4, 3): u, v, 1
rays = np.einsum("nij,jk,nck->nci", R_sfm_camera, np.linalg.inv(K), pixels)
square = np.column_stack([marker_square(MARKER_SIZE), np.zeros(4)])
corners_world = square @ T_WORLD_MARKER[:3, :3].T + T_WORLD_MARKER[:3, 3]


def corners_sfm(weights):
    """(4, 3) the marker's corners in the frame of SfM, from the rays of all photos."""
    return np.array([triangulate(centres, rays[:, corner], weights)[0] for corner in range(4)])


def corners_weighted():
    """The similarity of corners triangulated again, with the distances of the first time."""
    Z = np.linalg.norm(corners_sfm(all_alike).mean(axis=0) - centres, axis=1)
    return fit_similarity(corners_sfm(1.0 / Z**2), corners_world, np.ones(4))


def corners_alike():
    """The similarity of corners from rays of equal weight."""
    return fit_similarity(corners_sfm(all_alike), corners_world, np.ones(4))


recipes["corners, equal weights"] = corners_alike
recipes["corners, weights 1/Z²"] = corners_weighted
report("corners, equal weights")
report("corners, weights 1/Z²")

# %% [markdown]
# ## 5 The figure
# Above, the hall from above: where the photos were taken, and where the first and the last recipe put them. Below, the
# errors of all recipes.

# %% figure="hall"
draw_hall(p_world, placed)
plt.show()

# %% [markdown]
# *In words: long orange lines lead from each true place to where the first recipe puts it, metres off; with the last
# recipe blue circles sit on the true places. Below, the mean error is 5.7 m for the first and 0.13 m for the last.*
#
# **Question on the figure.** Which of the remedies uses knowledge about the errors, and which one needs none?
# What does the latter rely on instead?

# %% [markdown] answer="hall_reading"
# The weights use how errors grow with distance: a place from a photo as Z³, a ray's miss as Z. (Polishing uses a noise
# model as well: errors are made in pixels.) The median needs no such knowledge; it relies on a majority of good
# photos, here 43 of 72. On average the 5.7 m become 0.22 m without outliers, 0.14 m with weights and 0.13 m with weighted
# corners; no recipe here combines weights with the median.

# %% [markdown]
# ## Questions
# **Question 1.** A marker of 80 cm is seen from 20 m with $f$ = 397 px and $\sigma$ = 0.3 px. Estimate both errors of a
# single photo. How do they change with a marker twice as large? With a camera of twice the resolution (same noise in
# px)?

# %% [markdown] answer="q1"
# Along the view $Z^2\sigma/(fL) = 400 \cdot 0.3/(397 \cdot 0.8)$ = 0.38 m; across it $Z^3\sigma/(fL^2) = 8000 \cdot
# 0.3/(397 \cdot 0.64)$ = 9.4 m. A marker twice as large: half and a quarter, 0.19 m and 2.4 m. Twice the resolution
# doubles $f$ in pixels: half of both. So print it large. (9.4 m means a tilt of 27°: here the small-angle formula ends,
# and the two poses begin.)

# %% [markdown]
# **Question 2.** The paper writes "rigid transform". Why can that not be meant? And the corners' recipe gets a hall with
# four points that are only 80 cm apart: what limits it, and which further measurement in the hall would help most?

# %% [markdown] answer="q2"
# A rigid transform has no scale, but SfM from one camera cannot recover the metre: here a unit is 3.04 m. With scale it is
# a similarity. The limit is leverage: an error of 1 mm in a corner is 1/800 of the marker, so 5 cm at 40 m, in scale
# and in angle. Further points far from the marker help most: the corners of the landing pad, 14 m away, measured
# by tape (the kit does that; it leaves about 3 cm). A second marker at the other end would do as well.

# %% quiz="quiz"
from falconwing_kit.tools.grading import check_quiz

quiz = {1: None, 2: None, 3: None, 4: None, 5: None}
check_quiz(quiz)

# %% [markdown]
# ## What you can do now
# You can put a camera's world where it belongs, and say how well. `falconwing scene poses` and `falconwing scene align`
# do it for your own hall's photos; `falconwing_kit/tools/capture/align.py` keeps the recipe that fails beside the one
# that works, and refines all seven numbers on the pixels.
#
# **With hardware.** Print a marker (DICT_4X4_50, id 7) and measure its black square. Photograph it from 1, 2, 4 and 8
# m, straight on and from 30° aside, five photos each, with the tape on the floor. Detect it with OpenCV, compute the
# places with your `marker_pose`, and hand in your own figure of error over distance, with photos of the set-up.
