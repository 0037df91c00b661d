"""survey: what a tape measured in the hall, and where the photos show it."""
