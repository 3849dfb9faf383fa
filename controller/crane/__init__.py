"""The crane and its bus crane0: inputs, outputs, nodes, start-up, references and control."""
