"""tools: what is used and not read (command line, grading, capture, bridge, ...); the book never
imports it.
"""
