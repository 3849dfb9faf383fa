"""Path-traced pictures of logs: scenes described as plain data, drawn by Blender's Cycles in another process."""
