"""Episode stores: what they hold, where they come from."""

from ringfence.data.store import EpisodeStore

__all__ = ["EpisodeStore"]
