"""Wrong solutions of lab 2: what is wrong, the replaced text, the replacement."""

MUTANTS = {
    "rot_from_euler": (
        (
            "heading as if the runway pointed north",
            ' - np.radians(COHORT["runway_heading_deg"])',
            "",
        ),
        (
            "degrees for radians",
            'np.radians(COHORT["runway_heading_deg"])',
            'COHORT["runway_heading_deg"]',
        ),
        ("yaw counted to the left", "yaw = heading - np.radians(", "yaw = -heading + np.radians("),
        ("the textbook's axes, not the map's", "return right_along_up @ ", "return "),
        (
            "the kit's world instead of the map",
            "[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]",
            "[[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]",
        ),
        (
            "turns in the wrong order",
            "turn_yaw @ turn_pitch @ turn_roll",
            "turn_roll @ turn_pitch @ turn_yaw",
        ),
        ("pitch and roll swapped", "turn_pitch @ turn_roll", "turn_roll @ turn_pitch"),
        ("nose down for up", "np.cos(pitch), np.sin(pitch)", "np.cos(pitch), -np.sin(pitch)"),
        ("left wing down for right", "np.cos(roll), np.sin(roll)", "np.cos(roll), -np.sin(roll)"),
        (
            "body from map",
            "return right_along_up @ turn_yaw @ turn_pitch @ turn_roll",
            "return (right_along_up @ turn_yaw @ turn_pitch @ turn_roll).T",
        ),
    ),
    "camera_pose": (
        ("tilted up", "[np.cos(tilt), 0.0, np.sin(tilt)]", "[np.cos(tilt), 0.0, -np.sin(tilt)]"),
        (
            "picture's down leans forward",
            "[-np.sin(tilt), 0.0, np.cos(tilt)]",
            "[np.sin(tilt), 0.0, np.cos(tilt)]",
        ),
        ("tilt forgotten", "[np.cos(tilt), 0.0, np.sin(tilt)]", "[1.0, 0.0, 0.0]"),
        ("axes in the order of the body", "[right, down, forward]", "[forward, right, down]"),
        (
            "rows for columns",
            "np.column_stack([right, down, forward])",
            "np.array([right, down, forward])",
        ),
        (
            "mount in map axes",
            "p_map_body + R_map_body @ p_body_camera",
            "p_map_body + p_body_camera",
        ),
        ("mount forgotten", " + R_map_body @ p_body_camera", ""),
        (
            "mount through the camera's rotation",
            "R_map_body @ p_body_camera",
            "R_map_body @ R_body_camera @ p_body_camera",
        ),
        ("attitude forgotten", "R_map_body @ R_body_camera", "R_body_camera"),
    ),
    "map_to_camera": (
        ("map from camera", "R_camera_map = R_map_camera.T", "R_camera_map = R_map_camera"),
        ("lens added", "(p_map - t)", "(p_map + t)"),
        (
            "turned before it is shifted",
            "(R_camera_map @ (p_map - t).T).T",
            "(R_camera_map @ p_map.T).T - t",
        ),
        ("lens forgotten", "(p_map - t)", "p_map"),
        ("columns returned", "(p_map - t).T).T", "(p_map - t).T)"),
        (
            "matrix on the wrong side",
            "(R_camera_map @ (p_map - t).T).T",
            "(p_map - t) @ R_camera_map",
        ),
    ),
    "project_points": (
        ("half a pixel in the kit's way", 'lens["cx"] - 0.5', 'lens["cx"]'),
        ("half a pixel the wrong way", 'lens["cy"] - 0.5', 'lens["cy"] + 0.5'),
        ("no distortion", "bend = 1.0 + ", "bend = 1.0 + 0.0 * "),
        ("r for r squared", "(slope_x**2 + slope_y**2)", "np.sqrt(slope_x**2 + slope_y**2)"),
        ("distance before the division", "(slope_x**2 + slope_y**2)", "(x**2 + y**2)"),
        ("distortion undone instead of done", "bend = 1.0 + ", "bend = 1.0 - "),
        ("mirrors what is behind", "np.where(z > 0.0, z, np.nan)", "np.where(z == 0.0, np.nan, z)"),
        ("one focal length for both", 'lens["fy"] * slope_y', 'lens["fx"] * slope_y'),
        ("v counted upwards", 'lens["fy"] * slope_y', '-lens["fy"] * slope_y'),
        ("row before column", "np.stack([u, v], axis=1)", "np.stack([v, u], axis=1)"),
        ("bends one direction only", "slope_y * bend", "slope_y"),
    ),
    "ground_points": (
        ("half a pixel forgotten", "(u + 0.5 - ", "(u - "),
        ("half a pixel the wrong way", "(v + 0.5 - ", "(v - 0.5 - "),
        ("ray left in camera axes", "T_map_camera[:3, :3] @ d_camera", "d_camera"),
        ("camera from map", "T_map_camera[:3, :3] @ d_camera", "T_map_camera[:3, :3].T @ d_camera"),
        ("starts from the origin", "points = t - ", "points = -"),
        (
            "floor behind the camera for the sky",
            "np.where(d_map[:, 2] < 0.0, d_map[:, 2], np.nan)",
            "d_map[:, 2]",
        ),
        ("walks away from the floor", "t - (t[2]", "t + (t[2]"),
        ("sky and floor confused", "d_map[:, 2] < 0.0", "d_map[:, 2] > 0.0"),
        ("one focal length for both", 'lens["fy"]', 'lens["fx"]'),
        ("only as far as 1 m down", "(t[2] / down)", "(1.0 / down)"),
        (
            "floor at the height of the camera",
            "[1.0, 1.0, 0.0]",
            "[1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 1.0]",
        ),
    ),
}
