"""modelling: the verbs that size an airframe, make scenes, fit the model and find the gap."""
