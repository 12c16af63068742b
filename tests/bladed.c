/* A library with Bladed's interface: answers what it is told, and misbehaves where it is asked to. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void DISCON(float *swap, int *fail, const char *input, const char *name, char *message)
{
    static int calls = 0;
    static float first = 0;
    float time = swap[1], wind = swap[26];
    (void)name;
    if (swap[0] == 0) {
        first = swap[22];
        printf("library started at %g\n", swap[19]);
        fflush(stdout);
    }
    if (swap[0] < 0) {
        FILE *file = fopen("ended.txt", "w");
        if (file) { fprintf(file, "%d", calls); fclose(file); }
    }
    calls++;
    if (wind == 40) { *fail = -1; strcpy(message, "wind is too\nstrong"); }
    if (wind == 41) { *fail = 1; strcpy(message, "wind is strong"); }
    if (wind == 42) *(volatile int *)0 = 1;
    if (wind == 43) { fprintf(stderr, "Fortran runtime error: no such file\n"); exit(2); }
    swap[44] = wind == 44 ? 0.0f / 0.0f : 0.01f * calls;              /* pitch, rad */
    swap[46] = first + swap[14] / 1000 + swap[20];                   /* torque, N m */
    swap[34] = wind == 45 ? 0.0f : 1.0f;                             /* on the grid */
    if (strlen(input) > 0 && time > 1e5f) swap[46] = (float)strlen(input);
}
