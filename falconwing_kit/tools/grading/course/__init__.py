"""course: what an instructor makes of a class's records: feedback, statistics, likeness, a person's
points, exports.
"""
