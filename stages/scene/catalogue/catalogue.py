"""Catalogues: objects by name, read from a file once for all stages of a process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from runner.contract import Refused
from stages.scene.catalogue.loading import read_objects
from stages.scene.catalogue.objects import CatalogueObject

BUILT_IN = Path(__file__).parents[1] / "catalogue.yaml"
"""The catalogue that comes with the package."""


@dataclass(frozen=True)
class Catalogue:
    """Objects by name."""

    objects: dict[str, CatalogueObject]

    @staticmethod
    def load(path: Path) -> Catalogue:
        """Reads a catalogue YAML file or a BOP ``models`` folder.

        Raises :class:`runner.contract.Refused` naming file, object, key and valid choices.
        """
        return Catalogue(read_objects(path))

    @staticmethod
    @cache
    def shared(path: Path) -> Catalogue:
        """As :meth:`load`, but read once for all stages of this process and of those that are forked from it."""
        return Catalogue.load(path)

    def __getitem__(self, label: str) -> CatalogueObject:
        """The object of that name.

        Raises:
            Refused: there is none; names those that there are.
        """
        if label not in self.objects:
            raise Refused(f"'{label}' is not in the catalogue, which has {', '.join(self.objects)}")
        return self.objects[label]
