"""How the data sets of a simulator are regenerated: one file each, which its tasks name (tasks.py). A recipe is a
module with

    about(task) -> dict                                        what a card says of the simulator: data of another is
                                                               made again
    whole(task, transitions) -> int                            the size that is made where so many steps are asked for
    collect(task, transitions, seed, card) -> EpisodeStore     whose card is `card` and more
    references(task) -> dict[str, Policy]                      for rows beside the table: the policy that collected the
                                                               data, if it was one, and what else is known to be good
    relabelled(task, store) -> (costs (T,), dict) | None       the costs of kept steps under this task's danger and what
                                                               the card says then, where they can be told
"""

COLLECTION = 271_828  # root of the collection keys and seeds, far from those of evaluation
