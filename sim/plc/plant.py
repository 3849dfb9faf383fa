"""The plant whose valves a PLC drives: the same physics and sensors as `sim.plant.Plant`, wired to the PLC's cards."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.plc.map import ESTOP_BYTES, Estop, Role, State, WordOrder
from machine.joints import JOINTS
from machine.profile import Profile
from sim.errors import PlantError
from sim.hydraulics.layout import PA_PER_BAR
from sim.nodes.valve import FUNCTIONS
from sim.plant import Plant
from sim.plc.program import Inputs, Program
from sim.wood.log_shape import LogSpec


class PlcPlant(Plant):
    """A machine on a fixed base behind a PLC, without any CAN bus; ``plc`` is its program.

    ``draw`` and ``key`` as in `sim.plc.command_arbiter.CommandArbiter`.

    Raises:
        PlantError: the machine drives, or as `sim.plant.Plant`.
    """

    def __init__(
        self,
        profile: Profile,
        seed: int = 0,
        truth: str = "nominal",
        logs: int = 1,
        *,
        role: Role,
        order: WordOrder = WordOrder.HIGH_FIRST,
        draw: Callable[[], int] | None = None,
        key: bytes | None = None,
        scene: str | Sequence[LogSpec] | None = None,
    ) -> None:
        if profile.carrier is not None:
            raise PlantError(
                "plc.mobile-machine",
                f"{profile.name} drives; the emulated PLC needs a crane on a fixed base, such as palms_471",
            )
        self.plc = Program(profile, role, self._inputs, order, draw, key)
        self._estop_key, self._estop_frame = load("crane").message("EstopStat").key, bytes(ESTOP_BYTES)
        super().__init__(profile, seed, truth, logs, scene=scene)

    def step(self, now_ns: int, received: list[tuple[str, Frame]]) -> list[tuple[str, int, bytes]]:
        """Advance to ``now_ns``; there is no bus, so no frame is received or sent."""
        self._run(now_ns, [])
        self._collect()
        return []

    def _spools(self, now_ns: int) -> list[float]:
        spools = list(self.plc.scan(now_ns))
        return self.spool_faults.apply(FUNCTIONS, spools) if self.spool_faults and self._powered() else spools

    def _powered(self) -> bool:
        return self.plc.state is State.EXECUTE

    def _tick(self, now_ns: int) -> None:
        self.estop.tick(now_ns)  # the safety module is wired to the PLC, which passes its frames on
        for key, data in self._crane_out:
            if key == self._estop_key:
                self._estop_frame = data
        self._crane_out.clear()

    def _commanded(self) -> bool:
        return self.plc.state is State.EXECUTE

    def _inputs(self, now_ns: int) -> Inputs:
        """Read the PLC's cards; an encoder is read as it would answer on its bus."""
        pressures = self._pressures()
        lift, tilt, ext = (pressures[name] for name in ("lift", "tilt", "ext"))
        opening, closing = pressures["grapple"]
        channels = self.estop.channels
        estop = Estop.CHANNEL_A * (channels[0] == 1) | Estop.CHANNEL_B * (channels[1] == 1)
        estop |= Estop.PILOT_ON * self.estop.pilot_on | Estop.RESET_PRESSED * self.estop.reset_pressed
        names = [j.name.lower() for j in JOINTS]
        return Inputs(
            positions=tuple(self.encoders[n].measure(now_ns) if n in self.encoders else None for n in names),
            pressure_bar=tuple(p / PA_PER_BAR for p in (*lift, *tilt, *ext, closing, opening)),
            opening=self.world.opening,
            load_kg=self.world.load_kg(),
            estop=estop,
            estop_frame=self._estop_frame,
        )
