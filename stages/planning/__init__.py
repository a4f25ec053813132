"""From what is moved onto what to where the hand can put it: plans whose every step the arm gets done."""
