"""What a student is trained to make small, one file each: how far its action is from the teacher's."""
