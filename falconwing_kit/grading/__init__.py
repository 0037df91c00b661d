"""grading: labs as students get them, checks they can run, and a judge that their code never meets."""
