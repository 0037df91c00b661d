"""Command line: words typed after `falconwing` in, tables, files and an exit code out."""
