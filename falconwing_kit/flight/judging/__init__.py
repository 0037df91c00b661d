"""judging: did a simulated flight do what it should, how well, and how sure are rates and means over many."""
