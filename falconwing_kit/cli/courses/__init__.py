"""courses: the verbs that build, check, grade and hand out labs."""
