"""Command line: the words after `falconwing` in; tables, files and an exit code out."""
