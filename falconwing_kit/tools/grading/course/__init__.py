"""Course: a class's records -> feedback, statistics, similarity, rubric, exports."""
