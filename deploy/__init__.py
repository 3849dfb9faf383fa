"""What makes timberhand a set of services of one computer.

``install.sh`` lays out program, units, settings and users, from a checkout or from a wheel (``__main__``); ``units``
are systemd's; ``system`` is what the rest of the system is told; ``timberhand.conf`` holds the settings, each with its
explanation.
"""
