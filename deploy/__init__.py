"""Installation of timberhand as systemd services.

``install.sh`` installs program, units, settings and users, from a checkout or a wheel (``__main__``); ``units`` are
the systemd units; ``system`` holds udev rules, users and kernel settings; ``timberhand.conf`` holds the settings with
their explanations.
"""
