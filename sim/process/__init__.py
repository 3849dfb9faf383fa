"""The live plant as a process: real-time loop, requests and views."""
