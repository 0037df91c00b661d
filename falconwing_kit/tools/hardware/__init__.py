"""the parts list, cameras, checklists and the power filter."""
