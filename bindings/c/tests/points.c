/* Writes the profile points of all frames of a scene to a file.
 *
 * A record has frame and column (32 bits each), repeatability, correlation length and scan
 * correlation length (64 bits each) and flags (16 bits), in the byte order of this machine.
 */
#include <lasertrace.h>
#include <stdio.h>
#include <stdlib.h>

static void must(lasertrace_status status)
{
    if (status != LASERTRACE_STATUS_OK) {
        fprintf(stderr, "%s\n", lasertrace_last_error());
        exit(1);
    }
}

static void put(FILE *file, const void *value, size_t size)
{
    if (fwrite(value, size, 1, file) != 1) {
        perror("points");
        exit(74);
    }
}

int main(int argc, char **argv)
{
    if (argc != 5) {
        fprintf(stderr, "usage: points SCENE FIRST COUNT FILE\n");
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
    must(lasertrace_scene_free(scene));

    lasertrace_frames frames = {0};
    frames.profile_length = (size_t)count * size.columns;
    frames.profiles = malloc(frames.profile_length * sizeof *frames.profiles);
    if (!frames.profiles)
        return 1;
    must(lasertrace_simulation_frames(simulation, first, count, &frames, NULL, NULL));
    must(lasertrace_simulation_free(simulation));

    FILE *file = fopen(argv[4], "wb");
    if (!file) {
        perror(argv[4]);
        return 74;
    }
    for (size_t i = 0; i < frames.profile_length; i++) {
        const lasertrace_profile_point *p = &frames.profiles[i];
        if (p->found != LASERTRACE_PROFILE_POINT)
            continue;
        const uint16_t flags = (uint16_t)p->flags;
        put(file, &p->frame, sizeof p->frame);
        put(file, &p->column, sizeof p->column);
        put(file, &p->repeatability, sizeof p->repeatability);
        put(file, &p->correlation_length, sizeof p->correlation_length);
        put(file, &p->scan_correlation_length, sizeof p->scan_correlation_length);
        put(file, &flags, sizeof flags);
    }
    free(frames.profiles);
    return fclose(file) == 0 ? 0 : 74;
}
