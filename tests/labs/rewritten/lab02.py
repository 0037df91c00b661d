"""Lab 2, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "rot_from_euler": (
        (
            "the turns are multiplied in the opposite order",
            "form",
            """
    def about(axis, angle):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        R = np.eye(3)
        R[i, i] = R[j, j] = np.cos(angle)
        R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
        return R

    yaw = heading - np.deg2rad(COHORT["runway_heading_deg"])
    flip = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return flip @ about(0, roll) @ about(1, pitch) @ about(2, yaw)
""",
        ),
        (
            "gives the map in body axes, the transposed matrix",
            "form",
            """
    def about(axis, angle):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        R = np.eye(3)
        R[i, i] = R[j, j] = np.cos(angle)
        R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
        return R

    yaw = heading - np.deg2rad(COHORT["runway_heading_deg"])
    flip = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return (flip @ about(2, yaw) @ about(1, pitch) @ about(0, roll)).T
""",
        ),
    ),
    "camera_pose": (
        (
            "the mount is added in map axes and the tilt is up",
            "form",
            """
    s, c = np.sin(tilt), np.cos(tilt)
    mount = np.array([[0.0, s, c], [1.0, 0.0, 0.0], [0.0, c, -s]])
    T = np.eye(4)
    T[:3] = np.hstack([R_map_body @ mount, (p_map_body + p_body_camera)[:, None]])
    return T
""",
        ),
        (
            "rows of the mount for its columns",
            "form",
            """
    s, c = np.sin(tilt), np.cos(tilt)
    mount = np.array([[0.0, 1.0, 0.0], [-s, 0.0, c], [c, 0.0, s]])
    T = np.zeros((4, 4))
    T[3, 3] = 1
    T[:3, :3] = R_map_body.dot(mount)
    T[:3, 3] = R_map_body.dot(p_body_camera) + p_map_body
    return T
""",
        ),
    ),
    "map_to_camera": (
        (
            "applies the pose itself to the points",
            "form",
            """
    ones = np.ones((len(p_map), 1))
    homogeneous = np.hstack([p_map, ones])
    return (T_map_camera @ homogeneous.T).T[:, :3]
""",
        ),
        (
            "takes the place off after turning",
            "form",
            """
    out = []
    for point in p_map:
        out.append(T_map_camera[:3, :3].T @ point - T_map_camera[:3, 3])
    return np.array(out)
""",
        ),
    ),
    "project_points": (
        (
            "the bend is that of the distance in pixels' axes only, each its own",
            "form",
            """
    ahead = p_camera[:, 2] > 0
    depth = np.where(ahead, p_camera[:, 2], np.nan)
    slopes = p_camera[:, :2] / depth[:, None]
    bent = slopes * (1 + lens["k1"] * slopes**2)
    focal = np.array([lens["fx"], lens["fy"]])
    centre = np.array([lens["cx"], lens["cy"]])
    return bent * focal + centre - 0.5
""",
        ),
        (
            "points behind the camera are drawn too, and the pixel's middle is forgotten",
            "form",
            """
    slopes = p_camera[:, :2] / p_camera[:, 2:]
    r2 = (slopes**2).sum(axis=1)
    bend = 1 + lens["k1"] * r2
    u = lens["cx"] + lens["fx"] * slopes[:, 0] * bend
    v = lens["cy"] + lens["fy"] * slopes[:, 1] * bend
    return np.column_stack((u, v))
""",
        ),
    ),
    "ground_points": (
        (
            "the rays keep to the camera's axes",
            "form",
            """
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (pixels[:, 0] + 0.5 - lens["cx"]) / lens["fx"]
    rays[:, 1] = (pixels[:, 1] + 0.5 - lens["cy"]) / lens["fy"]
    eye = T_map_camera[:3, 3]
    fall = np.where(rays[:, 2] > 0, rays[:, 2], np.nan)
    found = eye + rays * (eye[2] / fall)[:, None]
    found[:, 2] = 0
    return found
""",
        ),
        (
            "rays that rise hit the ground behind the camera",
            "form",
            """
    x = (pixels[:, 0] + 0.5 - lens["cx"]) / lens["fx"]
    y = (pixels[:, 1] + 0.5 - lens["cy"]) / lens["fy"]
    rays = np.column_stack([x, y, np.ones_like(x)]) @ T_map_camera[:3, :3].T
    eye = T_map_camera[:3, 3]
    times = -eye[2] / rays[:, 2]
    return np.column_stack([eye[0] + times * rays[:, 0], eye[1] + times * rays[:, 1], 0 * times])
""",
        ),
    ),
}
