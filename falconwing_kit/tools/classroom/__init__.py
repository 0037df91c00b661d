"""classroom: a flying page for a class, and what is shown and kept after each flight."""
