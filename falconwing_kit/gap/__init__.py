"""gap: where simulation and measurement disagree, which effect is missing, and how the gap closes
with it.
"""
