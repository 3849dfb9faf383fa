"""What both buses share: received messages with their age, protected messages to send, and the state of a bus."""
