"""The machine in the well-known messages of Foxglove, which Foxglove and Lichtblick show without a plug-in."""
