"""The classroom: one machine flies, browsers watch, a student takes the sticks."""
