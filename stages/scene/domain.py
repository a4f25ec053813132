"""What scenes and goals say as PDDL: the domain, and the names that it accepts."""

import re

TABLE = "table"
DOMAIN = """\
; Picking and placing on a table. Items rest on convex items and on the table, and in concave items.
(define (domain scene)
  (:requirements :adl :typing)
  (:types
    thing label - object        ; a label names a pose in the robot's base frame
    support region - thing      ; the table, items, and regions attached to items
    item - support)
  (:constants table - support)
  (:predicates
    (exist ?i - item)
    (clear ?s - support)                          ; nothing is on or in it
    (on ?i - item ?s - support)
    (in ?t - thing ?s - support)                  ; an item in a container, or a region in which its child is
    (has ?p - item ?r - region)                   ; the region is attached to the item's frame
    (at ?i - item ?l - label)                     ; perceived there, and not touched since
    (holding ?i - item)
    (handempty)
    (graspable ?i - item)
    (concave ?s - support)
    (roomy ?s - support)                          ; may carry several items; geometry says whether one more fits
    (may-rest ?i - item ?s - support)             ; worth trying
    (belongs ?i - item ?r - region)
    (turned ?i - item)                            ; it shows another side than the goal has; placed, it shows that one
    (obstructs ?o - item ?i - item ?t - thing))   ; it stands where the item would come on the support or in the region

  (:action pick
    :parameters (?i - item ?s - support)
    :precondition (and (handempty) (exist ?i) (graspable ?i) (clear ?i) (on ?i ?s))
    :effect (and (holding ?i) (not (handempty)) (not (on ?i ?s))
      (when (forall (?o - item) (or (= ?o ?i) (not (on ?o ?s)))) (clear ?s))
      (not (turned ?i))
      (forall (?l - label) (not (at ?i ?l)))
      (forall (?r - region) (not (in ?r ?i)))
      (forall (?r - region ?c - item) (when (has ?i ?r) (not (in ?r ?c))))
      (forall (?o - item ?t - thing) (not (obstructs ?i ?o ?t)))))

  (:action pick-from
    :parameters (?i - item ?s - item)
    :precondition (and (handempty) (exist ?i) (graspable ?i) (clear ?i) (in ?i ?s))
    :effect (and (holding ?i) (not (handempty)) (not (in ?i ?s))
      (when (forall (?o - item) (or (= ?o ?i) (not (in ?o ?s)))) (clear ?s))
      (not (turned ?i))
      (forall (?l - label) (not (at ?i ?l)))
      (forall (?r - region) (not (in ?r ?i)))
      (forall (?r - region ?c - item) (when (has ?i ?r) (not (in ?r ?c))))
      (forall (?o - item ?t - thing) (not (obstructs ?i ?o ?t)))))

  (:action place-on
    :parameters (?i - item ?s - support)
    :precondition (and (holding ?i) (may-rest ?i ?s) (not (concave ?s)) (or (roomy ?s) (clear ?s))
      (forall (?o - item) (not (obstructs ?o ?i ?s))))
    :effect (and (on ?i ?s) (handempty) (not (holding ?i)) (not (clear ?s))))

  (:action place-in
    :parameters (?i - item ?s - item)
    :precondition (and (holding ?i) (may-rest ?i ?s) (concave ?s)
      (forall (?o - item) (not (obstructs ?o ?i ?s))))
    :effect (and (in ?i ?s) (handempty) (not (holding ?i)) (not (clear ?s))))

  (:action place-at-region
    :parameters (?i - item ?r - region ?p - item ?s - support)
    :precondition (and (holding ?i) (may-rest ?i ?s) (belongs ?i ?r) (has ?p ?r) (or (on ?p ?s) (in ?p ?s))
      (or (roomy ?s) (clear ?s))
      (forall (?o - item) (and (not (obstructs ?o ?i ?s)) (not (obstructs ?o ?i ?r)))))
    :effect (and (in ?r ?i) (handempty) (not (holding ?i)) (not (clear ?s))
      (when (concave ?s) (in ?i ?s))
      (when (not (concave ?s)) (on ?i ?s)))))
"""


def symbol(name: str) -> str:
    """A name that PDDL accepts: lower case, letters first, no blanks."""
    plain = re.sub(r"[^a-z0-9_-]", "_", name.lower())
    return plain if plain[:1].isalpha() else f"o_{plain}"
