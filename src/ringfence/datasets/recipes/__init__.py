"""How the data sets of a simulator are regenerated: one file each, which ends in a `Recipe` that its tasks name."""

COLLECTION = 271_828  # root of the collection keys and seeds, far from those of evaluation
