"""One scan in, one pose out; needs neither torch nor Lightning."""
