"""A mission report with something in every field."""

from __future__ import annotations

from can_dbc.messages.mission import AbandonedLog, Fence, KnownLog, Landing, MachinePose, MissionReport

HERE = (63.657853, 19.895562)
MISSION_REPORT = MissionReport(
    schema=1,
    name="Test field",
    state="APPROACH",
    words="drives up to the log",
    ended=False,
    auto=True,
    single_step=False,
    paused="",
    waits_for="",
    failure="",
    order=3,
    refusal="",
    loaded=4,
    on_board=3,
    on_board_m3=0.29,
    unloaded=1,
    missed=2,
    given_up=(AbandonedLog(9, "log 9 was missed 3 times"),),
    driven_m=41.5,
    targets=(7,),
    crane="",
    here=MachinePose(HERE, 92.5, 0.02),
    route=(HERE, (63.657853, 19.896362), (63.658122, 19.896362)),
    closed=True,
    fences=(Fence(((63.6577, 19.8953), (63.6577, 19.8966), (63.6583, 19.8966), (63.6583, 19.8953)), False, "field"),),
    landings=(Landing((63.65800, 19.8957), "road"),),
    logs=(
        KnownLog(7, (63.657880, 19.895762), 90.0, 2.0, 0.25, 0.4, 0, False),
        KnownLog(9, (63.657820, 19.895962), 45.0, 2.0, 0.25, 30.0, 3, True),
    ),
)
