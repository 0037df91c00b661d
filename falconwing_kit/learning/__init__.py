"""learning: training networks on what the simulator shows. Each file here loads torch; importing
the room does not.
"""
