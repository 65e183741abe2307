"""How the data sets of a simulator are regenerated: one file each, which its tasks name (tasks.py). A recipe is a
module with

    about(task) -> dict                                        what a card says of the simulator: data of another is
                                                               made again
    whole(task, transitions) -> int                            the size that is made where so many steps are asked for
    collect(task, transitions, seed, card) -> EpisodeStore     whose card is `card` and more
    behaviour(tier) -> BehaviourPolicy | None                  the policy that collected a tier's data, if it was one
    relabelled(task, store) -> (costs (T,), dict) | None       the costs of kept steps under this task's danger and what
                                                               the card says then, where they can be told
"""

COLLECTION = 271_828  # root of the collection keys and seeds, far from those of evaluation
