"""How the data sets of a simulator are regenerated: one file each, which ends in a `Recipe` that its tasks name."""

COLLECTION = 271_828  # root of the collection keys and seeds, far from those of evaluation

# The version of the recipes. It names caches and stands in what data says of its origin. A release that regenerates
# other data has another one; one that does not keeps it, so that data, Worlds and results that are there already are
# found.
RECIPES = "0.1.0"
