"""The controller process: ``python -m controller --profile palms_471 --bus crane0=wire:crane0 --setpoint-port 5005``.

Chooses between the compiled tick and the interpreter before anything of the tick is imported
(`runtime.compiled`); the rest is `controller.process.command`.
"""

from __future__ import annotations

import sys

from runtime.compiled import activate

if __name__ == "__main__":
    if "--interpreter" not in sys.argv:
        activate()
    from controller.process.command import main

    sys.exit(main())
