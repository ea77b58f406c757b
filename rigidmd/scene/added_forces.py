"""Tables of [forces] that features add, in general."""

from rigidmd.scene.validation import Section


class AddedForce(Section):
    """A table of a force that a feature adds. It may have the keys cutoff_A and switch_start_A."""

    @property
    def label(self) -> str:
        """Its name in the log. Default: that of its file."""
        return type(self).__module__.rpartition(".")[2]

    @property
    def files(self) -> dict[str, str | None]:
        """Key -> the file that it names."""
        return {}

    @property
    def more_lengths(self) -> dict[str, float | None]:
        """Further lengths within which it acts, by their keys, Å."""
        return {}


class AddedForces(Section):
    """The keys of [forces] that features add: here none."""

    @property
    def added(self) -> dict[str, AddedForce]:
        """The tables of forces, by their keys."""
        return {}

    @property
    def added_not_summable(self) -> tuple[tuple[str, object], ...]:
        """Messages on keys that exclude a sum of dispersion, and whether they are set."""
        return ()
