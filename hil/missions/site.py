"""From a mission to the site that the plant is given: logs where the file says, or as many as asked for on the route.

The machine begins with its front axle at the first waypoint, looking east.
"""

from __future__ import annotations

from autonomy.localization.local_plane import Plane
from autonomy.missions.local_frame import yaw_from_bearing
from autonomy.missions.model import ForwardingMission
from machine.profile import Profile
from sim.site.log_supply import Lying, along_route, lay_out
from sim.site_file import Site


def site_of(mission: ForwardingMission, profile: Profile, seed: int, truth: str, logs: int = 0) -> Site:
    """The site; ``logs`` more than 0: so many along the route instead of those of the mission.  Raises ValueError."""
    carrier = profile.carrier
    if carrier is None:
        raise ValueError(f"{profile.name} stands still; a mission needs a machine that drives, such as aoro_fc8")
    if not mission.waypoints:
        raise ValueError("the mission has no route; add waypoints")
    first = mission.waypoints[0]
    # The machine's front axle begins at the first waypoint, so the rear frame's origin lies behind it.
    lat, lon, _ = Plane(first.latitude_deg, first.longitude_deg).geodetic(-carrier.front_axle_m, 0.0)
    origin = Plane(lat, lon)
    if logs:
        route = [origin.local(p.latitude_deg, p.longitude_deg)[:2] for p in mission.waypoints]
        return Site(lat, lon, along_route(profile, truth, seed, logs, route))
    places = [
        Lying(
            *origin.local(log.position.latitude_deg, log.position.longitude_deg)[:2],
            None if log.bearing_deg is None else yaw_from_bearing(log.bearing_deg), log.length_m, log.diameter_m,
        )
        for log in mission.logs
    ]  # fmt: skip
    laps = mission.options.laps
    return Site(lat, lon, lay_out(profile, truth, seed, places, laps), len(places), laps)
