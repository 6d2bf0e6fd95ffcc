"""ABB arms without EGM, over the sockets of our RAPID modules; RWS starts and stops the program."""
