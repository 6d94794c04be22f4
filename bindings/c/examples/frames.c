/* What a sensor takes: frames of a scene, and what it measures in them.
 *
 *     cc frames.c $(pkg-config --cflags --libs lasertrace) -o frames
 *     ./frames scenes/bracket/scene.toml 90 3 counts.bin
 *
 * takes frames 90, 91 and 92, and writes the counts of the first, 16 bits in this machine's
 * order of bytes, row by row.
 */
#include <lasertrace.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void must(lasertrace_status status)
{
    if (status != LASERTRACE_STATUS_OK) {
        fprintf(stderr, "%s\n", lasertrace_last_error());
        exit(1);
    }
}

static int show(uint32_t done, uint32_t total, void *user)
{
    (void)user;
    fprintf(stderr, "%u of %u frames\n", (unsigned)done, (unsigned)total);
    return 0;
}

/* Counts how often it is called, and stops at once. */
static int stop(uint32_t done, uint32_t total, void *user)
{
    (void)done;
    (void)total;
    ++*(int *)user;
    return 1;
}

int main(int argc, char **argv)
{
    if (argc != 5) {
        fprintf(stderr, "usage: frames SCENE FIRST COUNT FILE\n");
        return 64;
    }
    const uint32_t first = (uint32_t)strtoul(argv[2], NULL, 10);
    const uint32_t count = (uint32_t)strtoul(argv[3], NULL, 10);

    lasertrace_scene *scene = NULL;
    lasertrace_simulation *simulation = NULL;
    lasertrace_size size;
    must(lasertrace_scene_load(argv[1], &scene));
    must(lasertrace_scene_size(scene, &size));
    must(lasertrace_simulation_new(scene, 0, &simulation));
    must(lasertrace_scene_free(scene)); /* the simulation has its own */
    printf("%u x %u pixels, %u frames\n", (unsigned)size.columns, (unsigned)size.rows,
           (unsigned)size.frames);

    const size_t pixels = (size_t)size.columns * size.rows;
    lasertrace_frames frames;
    frames.image_length = frames.depth_length = count * pixels;
    frames.profile_length = (size_t)count * size.columns;
    frames.images = malloc(frames.image_length * sizeof *frames.images);
    frames.depths = malloc(frames.depth_length * sizeof *frames.depths);
    frames.profiles = malloc(frames.profile_length * sizeof *frames.profiles);
    if (!frames.images || !frames.depths || !frames.profiles)
        return 1;
    must(lasertrace_simulation_frames(simulation, first, count, &frames, show, NULL));

    size_t points = 0;
    double sum = 0;
    for (size_t i = 0; i < frames.profile_length; i++) {
        const lasertrace_profile_point *p = &frames.profiles[i];
        if (p->frame != first + i / size.columns || p->column != i % size.columns) {
            fprintf(stderr, "element %zu is of frame %u, column %u\n", i, (unsigned)p->frame,
                    (unsigned)p->column);
            return 1;
        }
        if (p->found == LASERTRACE_PROFILE_POINT && p->flags == 0) {
            points++;
            sum += p->deviation * p->deviation;
        }
    }
    if (points > 0)
        printf("%zu points without a flag, %.2f um off the CAD (root mean square)\n", points,
               1e3 * sqrt(sum / (double)points));

    FILE *file = fopen(argv[4], "wb");
    if (!file || fwrite(frames.images, sizeof *frames.images, pixels, file) != pixels
        || fclose(file) != 0) {
        perror(argv[4]);
        return 74;
    }

    /* Stopped after the first: those not taken hold nothing, and nothing of before. */
    int calls = 0;
    frames.images = memset(frames.images, 0x55, frames.image_length * sizeof *frames.images);
    const lasertrace_status status =
        lasertrace_simulation_frames(simulation, first, count, &frames, stop, &calls);
    if (status != LASERTRACE_STATUS_STOPPED || calls != 1) {
        fprintf(stderr, "status %d after %d calls, expected to be stopped\n", (int)status, calls);
        return 1;
    }
    for (size_t i = 0; i < frames.image_length; i++)
        if (frames.images[i] == 0x5555) {
            fprintf(stderr, "pixel %zu was not written\n", i);
            return 1;
        }

    must(lasertrace_simulation_free(simulation));
    free(frames.images);
    free(frames.depths);
    free(frames.profiles);
    return 0;
}
