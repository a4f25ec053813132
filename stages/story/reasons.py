"""Why something did not work, as stages say it in a line, in the words of a language."""

from __future__ import annotations

import re

from stages.story.words import Words

_NAMES = r"(?P<names>\w+(?:, \w+)*)"
_ITEM, _OTHER, _PLACE = r"(?P<item>\w+)", r"(?P<other>\w+)", r"(?P<place>\w+)"
_NUMBER, _OF = r"(?P<number>[\d.]+)", r"(?P<of>[\d.]+)"
_TEXT = r"'(?P<text>[^']*)'"
_WAY = r" on the way to [\w ]+"
"""Which motion was broken off."""
REASONS = {
    "answered": r"question=\d+: (?:nothing|\d+) is asked now",
    "busy": r"busy: waits for [\w' ]+; ask again after the verdict",
    "no_goal": rf"name={_TEXT}: no such goal.*",
    "empty": rf"name={_TEXT}: names no object; .*",
    "taken": rf"\w+={_TEXT}: there is a (?:goal|folder) of that name.*",
    "no_name": rf"\w+={_TEXT}: must consist of letters, digits, - and _ only",
    "too_long": rf"\w+={_TEXT}: must have at most {_NUMBER} bytes as UTF-8",
    "not_written": r".*: cannot be (?:written|deleted): (?P<text>.*)",
    "nothing_in_file": r"file: is no goal: it names no object",
    "no_file": r"file: is no goal: .*",
    "last_object": rf"what={_TEXT}: is the only object of the goal; .*",
    "idle": r"nothing is under way",
    "no_go": r"nothing waits for go",
    "no_arm": r"the arm is not under way",
    "beside": r"x=\S+ y=\S+: beside the table; .*",
    "no_answer": r"\S+: no answer to 'call' within \d+ s",
    "stopped_empty": r"stopped, as asked; in the hand: nothing",
    "stopped_holding": rf"stopped, as asked; in the hand: {_NAMES}",
    "stopped": r"stopped, as asked",
    "stopped_on_the_way": rf"\bas asked(?:{_WAY})?",
    "hand_empty": r"; in the hand: nothing",
    "hand_holding": rf"; in the hand: {_NAMES}",
    "barred": r"stopped, the way back is barred: ",
    "slipped": rf"(?:\bslip: )?the fingers are [\d.]+ mm apart{_WAY}",
    "left_behind": rf"(?:\bslip: )?nothing weighs on the hand \([\d.]+ N\){_WAY}",
    "pushed": rf"(?:\btouch: )?(?:[\d.]+ N at the hand|a joint is [\d.]+ degrees off){_WAY}",
    "knocked_over": rf"; knocked over: {_NAMES}",
    "gone": rf"; not seen any more: {_NAMES}",
    "remembered_only": rf"; remembered, not seen: {_NAMES}",
    "unproved": rf"let go of, neither felt to stand nor seen since: {_NAMES}",
    "else_holds": r"; every other relation of the goal holds",
    "too_few": rf"{_NUMBER} of {_OF} objects seen",
    "floats": rf"not seen: what carries {_NAMES}",
    "unseen": rf"not seen: {_NAMES}",
    "looks": rf" \({_NUMBER} looks at scene '[^']*'\)",
    "enough": rf"{_NUMBER} transfers were not enough; ",
    "replaced": rf"the plan was replaced {_NUMBER} times",
    "nothing_to_do": r"the planner finds nothing to do",
    "no_transfer": r"no transfer changes what is violated: every object is where the goal has it",
    "no_other_way": r"; no other way: ",
    "missing": rf"the goal needs {_NAMES}, not in the current scene",
    "circle": rf"in the goal {_NAMES} rest on each other in a circle",
    "must_move": rf"{_ITEM} would have to move from {_OTHER} to {_PLACE}, but it ",
    "must_move_beside": rf"{_ITEM} would have to move beside {_OTHER}, but it ",
    "must_turn": rf"{_ITEM} would have to be turned, but it ",
    "must_move_off": rf"{_ITEM} on {_OTHER} would have to move, but it ",
    "no_grasp": r"has no grasp in the catalogue",
    "too_wide": rf"is {_NUMBER} cm wide and the gripper takes {_OF} cm",
    "no_room_on_table": rf"no room on the table for {_ITEM} within reach",
    "no_room": rf"no room for {_ITEM} at {_OTHER} within reach",
    "in_the_way": rf": {_NAMES} in the way",
    "make_room": rf"{_NAMES} would have to make room and cannot",
    "no_order": rf"no sequence of transfers moves {_NAMES} while nothing cannot be moved",
    "no_hand_room": r"no order of transfers leaves room for the hand",
    "no_sequence": rf"no sequence of transfers moves {_NAMES} while (?P<fixed>\w+(?:, \w+)*) cannot be moved",
    "not_beside": rf"in\({_ITEM}_near_{_OTHER}, \w+\) does not hold",
    "not_faced": rf"faces\({_ITEM}, \w+\) does not hold",
    "not_on": rf"(?:on|in)\({_ITEM}, {_OTHER}\) does not hold",
    "not_clear": rf"clear\({_ITEM}\) does not hold",
    "not_there": rf"exist\({_ITEM}\) does not hold",
    "not_seen_on": rf"{_ITEM} is not seen on or in {_OTHER}",
    "wrong_side": rf"{_ITEM} is not seen to show the side that it should",
    "tipped": rf"{_ITEM} does not stand as it should",
    "not_felt": rf"(?:\bunknown: )?nothing was felt below {_ITEM} where it was let go of",
    "not_perceived": rf"{_ITEM} is not in the perceived scene",
    "no_room_aside": rf"no room to put {_ITEM} aside",
    "hides_same": rf"wherever {_ITEM} could be put, it would hide the same",
    "no_way_back": r"no free way back",
    "closed": rf"the fingers closed to {_NUMBER} mm instead of {_OF}",
    "opened": rf"the hand opened to {_NUMBER} mm of {_OF}",
    "not_home": r"no free motion home; too close: .*",
    "no_catalogue": r"the catalogue has no grasp for it",
    "out_of_reach": r"it is out of reach",
    "unreachable": r"no grasp of it is reachable without a collision",
    "no_approach": r"no straight approach to a grasp",
    "no_lift": r"no way to lift it",
    "no_motion": r"no free motion to the pre-grasp",
    "no_carry": r"no free motion that carries it to the target",
    "no_posture": r"no reachable posture above the target",
    "no_way_down": r"no free way down to the target",
    "no_way_out": r"no free way out after letting go",
    "at_ik": r"\bik: ",
    "at_pick": r"\bpick motion: ",
    "at_grasp": r"\bgrasp: ",
    "at_place": r"\bplace motion: ",
    "at_release": r"\brelease: ",
}
"""What stages say, by the key of what people are told instead. The longer comes first."""
_AS_SAID = ("number", "of", "text")


def told(reason: str, words: Words) -> str:
    """A reason in the words of a language; what is not known stays as the stage said it."""
    for key, pattern in REASONS.items():
        reason = re.sub(pattern, lambda match, key=key: words.part(f"because_{key}", **_parts(match, words)), reason)
    return reason


def _parts(match: re.Match[str], words: Words) -> dict[str, object]:
    return {
        name: text if name in _AS_SAID else words.nouns(text.split(", ")) for name, text in match.groupdict().items()
    }
