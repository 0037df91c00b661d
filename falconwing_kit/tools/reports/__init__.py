"""pages and figures."""
