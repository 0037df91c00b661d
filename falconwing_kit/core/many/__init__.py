"""many: one function on many items, on this machine or a cluster; what is done already is not done again."""
