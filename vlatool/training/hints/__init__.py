"""What a student learns from the inside of its teacher, one file each: how far apart what two blocks give is."""
