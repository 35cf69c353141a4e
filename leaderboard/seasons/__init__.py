"""Seasons: tasks that nobody sees before they count, offline and online, of one board.

`COMMANDS` are their commands, by name: module and summary. A board gets the rest where it is
opened (`store`), served and shown (`web`: routes and pages), fetched and checked (`publication`).
"""

_ENTRANT, _ORGANISER = f"{__name__}.entrant", f"{__name__}.cli"

COMMANDS = {
    "enter": (_ENTRANT, "Take part in a sealed-offline season."),
    "ticket": (_ENTRANT, "Start a ticket: hidden tasks of a season, for you alone."),
    "answer": (_ENTRANT, "Answer the challenges of a ticket with trained policies."),
    "season": (_ORGANISER, "Sealed seasons: tasks that nobody but the organiser knows."),
}
