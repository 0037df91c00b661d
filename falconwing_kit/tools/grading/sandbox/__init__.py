"""Sandbox: a process in which a student's code runs without network, files or rights."""
