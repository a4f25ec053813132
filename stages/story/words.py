"""Texts of a language: sentences with places for names, and the names of objects with their articles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from runner.page.story import Language

NAMES = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Noun:
    """The name of a thing. In a format it takes a case: ``{cup}``, ``{cup:dat}``, ``{cup:acc}``."""

    text: str
    cases: Mapping[str, Mapping[str, str]]
    """What becomes of an article in a case."""

    def __format__(self, case: str) -> str:
        article, space, rest = self.text.partition(" ")
        return f"{self.cases.get(article, {}).get(case, article)}{space}{rest}"


@dataclass(frozen=True, slots=True)
class Nouns:
    """Several, as one part of a sentence: the cup, the tray and the bowl."""

    nouns: Sequence[Noun]
    conjunction: str

    def __format__(self, case: str) -> str:
        *first, last = (format(noun, case) for noun in self.nouns)
        return f"{', '.join(first)} {self.conjunction} {last}" if first else last


class Words:
    """The texts of one language."""

    def __init__(self, texts: Mapping[str, Any]) -> None:
        self._texts: Mapping[str, str] = texts["texts"]
        self._nouns: Mapping[str, str] = texts["nouns"]
        self._cases: Mapping[str, Mapping[str, str]] = texts["cases"]

    def say(self, key: str, **parts: object) -> str:
        """The text of a key with its parts, beginning with a capital."""
        return self.capital(self.part(key, **parts))

    @staticmethod
    def capital(text: str) -> str:
        """The beginning of a sentence."""
        return text[:1].upper() + text[1:]

    def part(self, key: str, **parts: object) -> str:
        """The same within a sentence."""
        return self._texts[key].format(**parts)

    def noun(self, name: str) -> Noun:
        """An object by its name in a scene: that of its label, with a number where there are several."""
        label, _, number = name.rpartition("_")
        label, number = (label, f" {number}") if label and number.isdecimal() else (name, "")
        known = self._nouns.get(label)
        return Noun((known or self._texts["unnamed"].format(name=label.replace("_", " "))) + number, self._cases)

    def bare(self, name: str) -> str:
        """Its name without an article: a label."""
        text = self.noun(name).text
        article, _, rest = text.partition(" ")
        return rest if article in self._cases else text

    def nouns(self, names: Sequence[str]) -> Nouns:
        """Several objects by their names."""
        return Nouns([self.noun(name) for name in names], self._texts["and"])


@cache
def words_of(language: Language) -> Words:
    """Reads the texts of a language."""
    return Words(yaml.safe_load((NAMES / f"{language}.yaml").read_text()))
