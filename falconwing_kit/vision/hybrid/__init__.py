"""hybrid: the steps of the hybrid state estimate that stand on their own."""
