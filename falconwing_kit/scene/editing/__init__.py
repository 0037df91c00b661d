"""Editing's helpers: colours that turn with their asset, random looks, masks of an aircraft in the image."""
