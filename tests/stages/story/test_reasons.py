"""Why something did not work, as stages say it, in the words of people."""

from __future__ import annotations

import pytest

from stages.story.reasons import REASONS, told
from stages.story.words import words_of

SAID = {
    "stopped, as asked": "angehalten, wie gewünscht",
    "stopped, as asked; in the hand: tea_box": "angehalten, wie gewünscht; in der Hand ist noch die Teeschachtel",
    "interactive-20261122-205043: no answer to 'call' within 10 s": (
        "das Programm des Roboters antwortet nicht; ob das bei ihm angekommen ist, weiß niemand"
    ),
    "question=1: nothing is asked now": "diese Frage ist schon beantwortet",
    "busy: waits for the person's arrangement; ask again after the verdict": (
        "der Roboter ist beschäftigt; warten Sie, bis er fertig ist, oder halten Sie ihn an"
    ),
    "name='lunch': no such goal in /somewhere; valid: none, teach one first": "keine Szene ist als „lunch“ gemerkt",
    "to='a b': must consist of letters, digits, - and _ only": (
        "„a b“ geht nicht als Name: nur Buchstaben, Ziffern, - und _"
    ),
    "name='Frühstück': must have at most 100 bytes as UTF-8": "„Frühstück“ ist als Name zu lang",
    "/home/a b/goals/tea: cannot be written: No space left on device": (
        "die Festplatte lässt mich nicht ändern, was ich mir gemerkt habe: No space left on device"
    ),
    "as asked on the way to show 2": "angehalten, wie gewünscht",
    "stopped, the way back is barred: 31 N at the hand on the way to go home; in the hand: cup": (
        "der Arm bleibt, wo er ist, denn der Weg zurück ist versperrt: der Arm ist an etwas gestoßen; "
        "in der Hand ist noch die Tasse"
    ),
    "slip: the fingers are 3 mm apart on the way to lift tea_box; no other way: no room to put tray aside": (
        "das Ding ist aus der Hand gerutscht; es gibt keinen anderen Weg: es ist kein Platz, um das Tablett "
        "beiseitezustellen"
    ),
    "not seen: cup; every other relation of the goal holds; knocked over: mug": (
        "nicht zu sehen: die Tasse; alles andere ist am Platz; umgefallen: der Becher"
    ),
    "let go of, neither felt to stand nor seen since: cup (3 looks at scene 'after transfer 1')": (
        "losgelassen, ohne den Stand zu spüren, und seitdem nicht gesehen: die Tasse, nach 3-mal Hinsehen"
    ),
    "name='tea': names no object; teach it again, or restore another one": "in der Szene „tea“ ist nichts",
    "file: is no goal: it names no object": "in der Szene dieser Datei ist nichts",
    "what='tea_box': is the only object of the goal; delete the goal instead": (
        "es ist das einzige Ding, das noch darin ist; löschen Sie stattdessen die Szene"
    ),
    "unknown: nothing was felt below cup where it was let go of": (
        "unter der Tasse war beim Loslassen nichts zu spüren"
    ),
    "2 of 6 objects seen (3 looks at scene 'goal')": "nur 2 von 6 Dingen waren zu sehen, nach 3-mal Hinsehen",
    "not seen: cup, tea_box": "nicht zu sehen: die Tasse und die Teeschachtel",
    "not seen: what carries soup_can (1 looks at scene 'start')": (
        "unter der Suppendose war nichts zu sehen, nach 1-mal Hinsehen"
    ),
    "16 transfers were not enough; in(tea_box_near_tray, tea_box) does not hold": (
        "nach 16 Bewegungen ist es noch nicht geschafft: die Teeschachtel ist nicht neben dem Tablett"
    ),
    "3 transfers were not enough; on(cup, tray) does not hold": (
        "nach 3 Bewegungen ist es noch nicht geschafft: die Tasse ist nicht, wo es hingehört, auf oder in dem Tablett"
    ),
    "grasp: the fingers closed to 5 mm instead of 60; no other way: no room on the table for cup within reach: "
    "tray, mug in the way": (
        "beim Greifen: die Finger schlossen sich auf 5 mm statt 60 mm, um nichts oder etwas anderes; "
        "es gibt keinen anderen Weg: für die Tasse ist auf dem Tisch kein Platz in Reichweite; "
        "im Weg: das Tablett und der Becher"
    ),
    "tray would have to move from table to cup, but it is 31.0 cm wide and the gripper takes 9.5 cm": (
        "das Tablett müsste von dem Tisch weg, hin zu der Tasse, aber das Ding ist 31.0 cm breit, "
        "und die Hand fasst 9.5 cm"
    ),
    "no sequence of transfers moves cup while nothing cannot be moved": (
        "die Tasse lässt sich in keiner Reihenfolge dorthin bringen"
    ),
    "slip: nothing weighs on the hand (0.1 N) on the way to lift cup": "das Ding blieb stehen, als die Hand es hob",
    "no transfer changes what is violated: every object is where the goal has it; in(cup, tray) does not hold": (
        "etwas stimmt nicht, und etwas zu bewegen hilft nicht; die Tasse ist nicht, wo es hingehört, "
        "auf oder in dem Tablett"
    ),
    "the planner finds nothing to do; in(cup, tray) does not hold (3 looks at scene 'start')": (
        "etwas stimmt nicht, und ich weiß nicht, was zu bewegen ist; die Tasse ist nicht, wo es hingehört, "
        "auf oder in dem Tablett, nach 3-mal Hinsehen"
    ),
    "the plan was replaced 9 times; in(cup, tray) does not hold": (
        "der Plan musste 9-mal geändert werden; die Tasse ist nicht, wo es hingehört, auf oder in dem Tablett"
    ),
    "no order of transfers leaves room for the hand: cup, mug in the way": (
        "in keiner Reihenfolge ist Platz für die Hand; im Weg: die Tasse und der Becher"
    ),
    "release: cup is not seen on or in tray": "beim Loslassen: die Tasse ist nicht auf oder in dem Tablett zu sehen",
    "mug would have to be turned, but it has no grasp in the catalogue": (
        "der Becher müsste gedreht werden, aber das Ding lässt sich nicht greifen"
    ),
    "2 transfers were not enough; faces(mug, back) does not hold": (
        "nach 2 Bewegungen ist es noch nicht geschafft: der Becher zeigt nicht die Seite, die sichtbar sein soll"
    ),
    "mug is not seen to show the side that it should; every other relation of the goal holds": (
        "bei dem Becher ist nicht zu sehen, dass die gewünschte Seite vorn ist; alles andere ist am Platz"
    ),
    "the goal needs cup_2, not in the current scene": "es fehlt: die Tasse 2",
}
"""With what is said of it in German."""


@pytest.mark.parametrize("reason", SAID)
def test_what_stages_say_is_said_in_german(reason: str) -> None:
    assert told(reason, words_of("de")) == SAID[reason]


@pytest.mark.parametrize("reason", SAID)
def test_no_names_of_the_catalogue_are_left(reason: str) -> None:
    for language in ("en", "de"):
        assert "_" not in told(reason, words_of(language)).replace("- und _", "").replace("- and _", "")


def test_what_is_not_known_stays_as_it_was_said() -> None:
    assert told("the sky fell on it", words_of("de")) == "the sky fell on it"


@pytest.mark.parametrize("language", ["en", "de"])
def test_every_reason_has_its_words(language: str) -> None:
    texts = words_of(language)  # type: ignore[arg-type]
    for key in REASONS:
        parts = dict.fromkeys(("item", "other", "place"), texts.noun("cup"))
        names = dict.fromkeys(("names", "fixed"), texts.nouns(["cup", "tray"]))
        assert texts.part(f"because_{key}", **parts, **names, number="3", of="6", text="lunch")
