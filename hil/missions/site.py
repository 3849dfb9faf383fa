"""The plant's site for a mission: the logs of the mission file, or a given number along the route.

The machine starts with its front axle at the first waypoint, heading east.
"""

from __future__ import annotations

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.local_frame import yaw_from_bearing
from autonomy.missions.model import ForwardingMission
from machine.profile import Profile
from runtime.errors import InputRefused
from sim.site.log_supply import LogPlace, along_route, place_logs
from sim.site.site_file import Site


def site_of(
    mission: ForwardingMission, profile: Profile, seed: int, truth: str, logs: int = 0, terrain: str = "flat"
) -> Site:
    """Make the site; ``logs`` > 0 lays that many along the route instead of those of the mission.

    ``terrain`` is the kind of its ground, one of `sim.ground.terrain.KINDS`.

    Raises:
        InputRefused: the machine does not drive, or the mission has no route.
    """
    carrier = profile.carrier
    if carrier is None:
        raise InputRefused(
            "mission.stationary-machine",
            f"{profile.name} does not drive; a mission needs a machine with a carrier, such as aoro_fc8",
        )
    if not mission.waypoints:
        raise InputRefused("mission.no-route", "the mission has no route; add waypoints")
    first = mission.waypoints[0]
    # The front axle starts at the first waypoint, so the origin of the rear frame lies behind it.
    lat, lon, _ = LocalPlane(first.latitude_deg, first.longitude_deg).geodetic(-carrier.front_axle_m, 0.0)
    origin = LocalPlane(lat, lon)
    if logs:
        route = [origin.local(p.latitude_deg, p.longitude_deg)[:2] for p in mission.waypoints]
        return Site(lat, lon, along_route(profile, truth, seed, logs, route), terrain=terrain)
    places = [
        LogPlace(
            *origin.local(log.position.latitude_deg, log.position.longitude_deg)[:2],
            None if log.bearing_deg is None else yaw_from_bearing(log.bearing_deg),
            log.length_m,
            log.diameter_m,
        )
        for log in mission.logs
    ]
    laps = mission.options.laps
    return Site(lat, lon, place_logs(profile, truth, seed, places, laps), len(places), laps, terrain)
