"""The settings of the services, and what a machine's configuration consists of: read, checked, compared, migrated."""
