"""What every experiment needs: its command, its tables, its clock, its wheels."""
