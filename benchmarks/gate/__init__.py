"""The gate: short trainings against a stored baseline, to be passed before a release.

judging      what is worse than the baseline, from numbers alone
baseline     the stored numbers, by kind of machine
trainings    scenes, trainings, and the older build that they take turns with
"""
