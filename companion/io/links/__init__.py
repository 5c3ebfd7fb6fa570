"""Links: UDP, TCP, serial ports and pseudo terminals, their addresses and specifications."""
