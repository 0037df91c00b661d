"""networks: the learned parts of vision, in plain torch. Everything here loads torch; files one floor up are the doors."""
