"""links: lines to the board, a serial port or a simulated board in real time."""
