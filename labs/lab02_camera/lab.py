# %% [markdown]
# # Lab 2: Frames and camera
# **One aircraft, three conventions, and where a point of the hall appears in the picture.**
#
# ![Two views of a hall with the outlines of pad and marker drawn exactly over them, and a map of what each view shows](goal.webp)
#
# *What you will have at the end (open course).*
#
# The autopilot logs its attitude against north, east and down. You think on a map: right, along the runway, up. The
# camera counts right, down, forward, and its picture counts pixels. Every sign you get wrong here comes back later as
# an aircraft that turns away from the runway.
#
# **You will be able to**
# - turn roll, pitch and compass heading into a rotation matrix, and read its columns,
# - place a tilted camera on an aircraft, and see the hall in its axes,
# - project points through a lens that bends lines, and go back from a pixel to the floor.
#
# **Time** about 3 hours. **Before** lab 1, matrices, sine and cosine. **Paper** Section "Photorealistic Simulation via
# Gaussian Splatting", paragraph "Data Collection and Calibration". The views are simulated.

# %%
import given
import matplotlib.pyplot as plt
import numpy as np
from given import COHORT

from falconwing_kit.tools.grading import check

views, lens, tilt, p_body_camera = given.load_views()
print("your course:", COHORT)
print("the lens:", lens)

# %%
from falconwing_kit.tools.grading import borrow, keep_going

keep_going()  # a missing function stops only the cells that need it
given.moving_attitude()

# %% [markdown]
# *In words: left, an aircraft seen from behind with its three body axes; right, the hall through its camera: floor, end wall,
# pad and marker as lines. When the nose goes right the picture goes left, when the nose goes up the picture goes down,
# and when the right wing drops the picture turns to the left.*

# %% [markdown]
# ## Three frames
#
# | frame | x | y | z | who uses it |
# |---|---|---|---|---|
# | `map` | right, across the hall | along the runway | up | you, in this lab; origin on the floor under the marker |
# | `body` | nose | right wing | belly | textbooks and autopilots; origin in the centre of gravity |
# | `camera` | right in the picture | down in the picture | forward | OpenCV; origin in the lens |
#
# All three are right-handed. (The kit's own `world` is a fourth one: x along the runway, y left, z up.)
#
# **Names carry frames.** `R_map_body` turns a vector written in body axes into the same vector written in map axes:
# `v_map = R_map_body @ v_body`. Read it "map from body". Inner names must meet. Its columns are the nose, the right
# wing and the belly, written in the map. That one sentence solves half of this lab.
#
# ## 1 Attitude
# Attitude is described by three rotations (Euler angles), from a level aircraft that points forward. First it turns by
# $\psi$ to the right (yaw), then its nose rises by $\theta$ (pitch), then its right wing drops by $\phi$ (roll). In axes
# forward, right, down:
#
# $$R = \begin{pmatrix} \cos\psi & -\sin\psi & 0 \\ \sin\psi & \cos\psi & 0 \\ 0 & 0 & 1 \end{pmatrix}
# \begin{pmatrix} \cos\theta & 0 & \sin\theta \\ 0 & 1 & 0 \\ -\sin\theta & 0 & \cos\theta \end{pmatrix}
# \begin{pmatrix} 1 & 0 & 0 \\ 0 & \cos\phi & -\sin\phi \\ 0 & \sin\phi & \cos\phi \end{pmatrix}$$
#
# Two things are left to you. The map's axes are right, along, up and not forward, right, down: swap and flip rows. And
# a compass counts the heading from north, while the runway of your course points `COHORT["runway_heading_deg"]` degrees
# right of north.
#
# Write `rot_from_euler`.


# %% exercise="rot_from_euler"
def rot_from_euler(roll, pitch, heading):
    """Attitude as an autopilot logs it, as a rotation in the map.

    The runway points COHORT["runway_heading_deg"] degrees right of north.

    Args:
        roll: [rad], positive right wing down.
        pitch: [rad], positive nose up.
        heading: of the nose, right of north [rad].

    Returns:
        R_map_body (3, 3); columns: nose, right wing, belly in map axes (right, along, up).
    """
    # BEGIN SOLUTION
    yaw = heading - np.radians(COHORT["runway_heading_deg"])
    cos_r, sin_r = np.cos(roll), np.sin(roll)
    cos_p, sin_p = np.cos(pitch), np.sin(pitch)
    cos_y, sin_y = np.cos(yaw), np.sin(yaw)
    turn_yaw = np.array([[cos_y, -sin_y, 0.0], [sin_y, cos_y, 0.0], [0.0, 0.0, 1.0]])
    turn_pitch = np.array([[cos_p, 0.0, sin_p], [0.0, 1.0, 0.0], [-sin_p, 0.0, cos_p]])
    turn_roll = np.array([[1.0, 0.0, 0.0], [0.0, cos_r, -sin_r], [0.0, sin_r, cos_r]])
    right_along_up = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return right_along_up @ turn_yaw @ turn_pitch @ turn_roll
    # END SOLUTION


# %% check="rot_from_euler"
check(rot_from_euler)

# %%
R_map_body = rot_from_euler(0.0, np.radians(10.0), np.radians(COHORT["runway_heading_deg"] + 90.0))
for name, column in zip(("nose", "right wing", "belly"), R_map_body.T, strict=True):
    print(f"{name:>10} points to", np.round(column, 3) + 0.0, "(right, along, up)")

# %% [markdown]
# Before you read on: is that right, for an aircraft that flies across the runway to the right and climbs?
#
# ## 2 The camera on the aircraft
# A pose is a rotation and a place in one matrix:
#
# $$T_\mathrm{map\,camera} = \begin{pmatrix} R_\mathrm{map\,camera} & t \\ 0\;0\;0 & 1 \end{pmatrix}$$
#
# where $t$ is the lens, written in the map. The camera sits at `p_body_camera` and looks along the nose, tilted *down*
# by the angle $\tau$. Untilted, its axes are right wing, belly, nose. Tilted, the optical axis leans from the nose
# towards the belly, and "down in the picture" leans from the belly towards the tail:
#
# ```text
#        nose
#   -------------->  body x          camera x: right wing
#   | \  tau                         camera y: belly, leaning back by tau
#   |   \                            camera z: nose, leaning down by tau
#   v     \ camera z
#  belly, body z
# ```
#
# Write `camera_pose`. First write down the three columns of `R_body_camera`.


# %% exercise="camera_pose"
def camera_pose(R_map_body, p_map_body, p_body_camera, tilt):
    """Where the camera is and where it looks.

    Args:
        R_map_body: (3, 3) attitude of the aircraft.
        p_map_body: (3,) its centre of gravity in the map [m].
        p_body_camera: (3,) the lens in body axes [m].
        tilt: of the optical axis, from the nose down towards the belly [rad].

    Returns:
        T_map_camera (4, 4).
    """
    # BEGIN SOLUTION
    right = np.array([0.0, 1.0, 0.0])
    down = np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    forward = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    R_body_camera = np.column_stack([right, down, forward])
    T_map_camera = np.eye(4)
    T_map_camera[:3, :3] = R_map_body @ R_body_camera
    T_map_camera[:3, 3] = p_map_body + R_map_body @ p_body_camera
    return T_map_camera
    # END SOLUTION


# %% check="camera_pose"
check(camera_pose)

# %% [markdown]
# ## 3 The hall in camera axes
# The pose takes camera coordinates to the map. We need the way back. A rotation's inverse is its transpose:
#
# $$p_\mathrm{camera} = R_\mathrm{map\,camera}^{\mathsf T} \, (p_\mathrm{map} - t)$$
#
# with the lens at $t$, in the pose's last column. Points come as rows, (N, 3). Think about which side of `@` the matrix
# stands on, and test with a number of points that is not 3.
#
# Write `map_to_camera`.


# %% exercise="map_to_camera"
def map_to_camera(p_map, T_map_camera):
    """The same points in camera axes.

    Args:
        p_map: (N, 3) points in the map [m].
        T_map_camera: (4, 4) pose of the camera.

    Returns:
        p_camera (N, 3) [m]: right, down, forward.
    """
    # BEGIN SOLUTION
    R_map_camera, t = T_map_camera[:3, :3], T_map_camera[:3, 3]
    R_camera_map = R_map_camera.T
    return (R_camera_map @ (p_map - t).T).T
    # END SOLUTION


# %% check="map_to_camera"
check(map_to_camera)

# %% [markdown]
# ## 4 Through the lens
# A camera sees slopes: $x' = x / z$ and $y' = y / z$. A wide lens pulls what is far from its axis inwards; one number
# $k_1$ describes most of it:
#
# $$r^2 = x'^2 + y'^2, \qquad u = f_x \, x' (1 + k_1 r^2) + c_x, \qquad v = f_y \, y' (1 + k_1 r^2) + c_y$$
#
# **Half a pixel.** Where is the centre of the picture's first pixel? In the kit at (0.5, 0.5): its coordinates begin at
# the picture's edge, and `lens["cx"]` follows this convention. OpenCV and `plt.imshow` put it at (0, 0). Your pixels
# shall be OpenCV's. In which direction is the half?
#
# Write `project_points`. What is not in front of the camera, z <= 0, is not in the picture: return nan for it.


# %% exercise="project_points"
def project_points(p_camera, lens):
    """Where points appear in the picture.

    Args:
        p_camera: (N, 3) points in camera axes [m].
        lens: dict with fx, fy, cx, cy [px], first pixel's centre at (0.5, 0.5), and k1 [-].

    Returns:
        pixels (N, 2): u to the right, v down, with the first pixel's centre at (0, 0);
            nan, nan where z <= 0.
    """
    # BEGIN SOLUTION
    x, y, z = p_camera.T
    z = np.where(z > 0.0, z, np.nan)
    slope_x, slope_y = x / z, y / z
    bend = 1.0 + lens["k1"] * (slope_x**2 + slope_y**2)
    u = lens["fx"] * slope_x * bend + lens["cx"] - 0.5
    v = lens["fy"] * slope_y * bend + lens["cy"] - 0.5
    return np.stack([u, v], axis=1)
    # END SOLUTION


# %% check="project_points"
check(project_points)

# %% [markdown]
# ## 5 Back to the floor
# One pixel gives a direction, not a point. But if the pixel shows the floor, the point is known: walk from the lens
# along the ray until z = 0.
#
# $$d_\mathrm{camera} = \Big(\tfrac{u + 0.5 - c_x}{f_x},\; \tfrac{v + 0.5 - c_y}{f_y},\; 1\Big), \qquad
# p_\mathrm{map} = t + s\, R_\mathrm{map\,camera}\, d_\mathrm{camera}, \qquad p_z = 0$$
#
# Solve the last equation for $s$. Where $s$ is not positive the ray never meets the floor: it looks at the wall or at
# the ceiling. The pixels you get are already free of distortion, so do not use $k_1$ here.
#
# Write `ground_points`.


# %% exercise="ground_points"
def ground_points(pixels, T_map_camera, lens):
    """Where on the floor, z = 0, the camera looks at each pixel.

    Args:
        pixels: (N, 2) u, v of a picture without distortion, first pixel's centre at (0, 0).
        T_map_camera: (4, 4) pose of the camera, above the floor.
        lens: dict with fx, fy, cx, cy [px], with the first pixel's centre at (0.5, 0.5).

    Returns:
        p_map (N, 3) [m], z = 0; nan, nan, nan where the ray does not go down.
    """
    # BEGIN SOLUTION
    u, v = pixels.T
    slope_x, slope_y = (u + 0.5 - lens["cx"]) / lens["fx"], (v + 0.5 - lens["cy"]) / lens["fy"]
    d_camera = np.stack([slope_x, slope_y, np.ones(len(pixels))])
    d_map = (T_map_camera[:3, :3] @ d_camera).T
    t = T_map_camera[:3, 3]
    down = np.where(d_map[:, 2] < 0.0, d_map[:, 2], np.nan)
    points = t - (t[2] / down)[:, None] * d_map
    return points * np.array([1.0, 1.0, 0.0])
    # END SOLUTION


# %% check="ground_points"
check(ground_points)

# %% [markdown]
# ## 6 The figure
# Now all functions together. Left and middle: two simulated views of the hall, and over them the pad (solid), the marker
# (dashed) and the map's axes on the marker, as projected by *your* functions. Right: the part of the floor that each view
# shows. If one sign is wrong, the lines do not match the picture.


# %% figure="axes"
def pose_of(view):
    """T_map_camera of a view, from its log."""
    R_map_body = rot_from_euler(view["roll"], view["pitch"], view["heading"])
    return camera_pose(R_map_body, view["p_map"], p_body_camera, tilt)


poses = [pose_of(view) for view in views]
fig, axes = plt.subplots(1, 3, figsize=(15, 5), width_ratios=[3, 3, 2])
for ax, view, pose in zip(axes, views, poses, strict=False):
    given.draw_view(ax, view, lambda p, pose=pose: project_points(map_to_camera(p, pose), lens))
seen = [given.undistorted(given.border(view["image"]), lens) for view in views]
footprints = [ground_points(pixels, pose, lens) for pixels, pose in zip(seen, poses, strict=True)]
given.draw_map(axes[2], footprints, [pose[:3, 3] for pose in poses])
axes[2].set_title("from above")
fig.tight_layout()
plt.show()

# %% [markdown]
# *In words: two pictures of a sports hall with a blue landing pad and a black and white marker; an outline lies on the
# top edge of the pad, another one on the edge of the marker; three arrows on the marker point right, away from the
# camera and up. The map beside shows the two cameras before the pad, and the wedge of floor that each one sees, open
# where its picture shows walls.*
#
# **Question on the figure.** Break one thing at a time, in the cell above, and look again: change the sign of the roll
# (`-view["roll"]`), leave out the tilt (`0.0` for `tilt`), leave out $k_1$ (look closely; `lens | {"k1": 0.0}` in
# `draw_view`'s line). Say which lines moved, and which way. Where in the picture would you have noticed
# $k_1$? Then put everything back.

# %% [markdown] answer="axes_reading"
# With the sign of the roll changed, pad and marker are turned about the picture's middle, by about twice the roll,
# against hall and horizon. Without the tilt all lines sink by about f tan(tilt) = 28 px, as if the camera looked too
# high. Without $k_1$ they move outwards by about a pixel at most: all that is drawn is near the middle. The shift grows
# with the cube of the distance from it, to about 16 px in the picture's corners.

# %% [markdown]
# The same without typing: move an error into the first view's roll, into the tilt or into $k_1$ (sliders in a running
# notebook). At the start nothing is wrong and the lines lie on pad and marker.

# %%
from falconwing_kit.tools.grading import Slider, figure_with_sliders


def view_with_errors(figure, roll_deg, tilt_deg, k1):
    """The first view, with errors added to its roll and to the tilt, and another k1."""
    view = views[0]
    R = rot_from_euler(view["roll"] + np.radians(roll_deg), view["pitch"], view["heading"])
    pose = camera_pose(R, view["p_map"], p_body_camera, tilt + np.radians(tilt_deg))
    bent = lens | {"k1": k1}
    given.draw_view(figure.subplots(), view, lambda p: project_points(map_to_camera(p, pose), bent))


figure_with_sliders(
    view_with_errors,
    "A hall with pad and marker; an outline lies on each, until an error moves it.",
    (7.0, 5.4),
    roll_deg=Slider("error of the roll [deg]", -30.0, 30.0, 0.0),
    tilt_deg=Slider("error of the tilt [deg]", -15.0, 15.0, 0.0),
    k1=Slider("k1 [-]", -0.5, 0.5, lens["k1"], 0.01),
)

# %% [markdown]
# ## Questions
# **Question 1.** A friend's overlay fits a view without roll well. In a banked view the lines are turned against the
# picture, by about twice the roll. Which mistake is it? And what would you see if the runway's heading were left out?

# %% [markdown] answer="q1"
# The sign of the roll is wrong: the picture's horizon leans one way and the lines the other, so the angle between them
# is twice the roll. It hardly shows where the roll is small, so test with large angles. Without the runway's heading
# all lines move sideways by the same angle, with f = 198 px by about 198 tan(angle) px, and mostly leave the picture;
# the horizon still fits, which makes this mistake look like a wrong position.

# %% [markdown]
# **Question 2.** How much does the half pixel matter? Give it in centimetres for something 10 m away, and say in which
# case of this course (landing on a pad 2 m wide, comparing two renders, fitting poses to thousands of points) you would
# have to care.

# %% [markdown] answer="q2"
# Half a pixel is an angle of 0.5 / 198 = 2.5 mrad (0.14°), or 2.5 cm at 10 m, in u and in v. Landing on a pad of 2 m:
# no. Comparing renders: yes, every edge differs. Fitting poses: yes, it is the same for all points, so it does not
# average out; it ends up in the pose.

# %% quiz="quiz"
from falconwing_kit.tools.grading import check_quiz

quiz = {1: None, 2: None, 3: None, 4: None, 5: None}
check_quiz(quiz)

# %% [markdown]
# ## What you can do now
# You can compute for every point of the hall where it appears in the picture, and back. The kit's versions are
# `falconwing_kit/core/frames.py` and `falconwing_kit/scene/camera.py`; they use the world frame, no tilt and no $k_1$.
# Lab 3 replaces points by small clouds of colour, and the overlay becomes a picture.
#
# **With hardware.** Print a chessboard, take 15 pictures of it with your webcam, and run OpenCV's `calibrateCamera` with
# k2, k3, p1 and p2 fixed at 0. Add 0.5 to its cx and cy: OpenCV counts the first pixel's centre as (0, 0).
# Hand in your lens (fx, fy, cx, cy, k1), the error it reports in pixels, and one picture with the chessboard's axes
# drawn by your `project_points`. Tape the board to something flat.
