"""Measurements on photos for the world alignment: marker, faces, survey points, video link."""
