"""hardware: tables of the list of parts, and checklists walked at the terminal."""
