/* Calls that are wrong: each must give its status and a message, and none may crash. The
 * rows are the table of README.md. Given a scene's file and the folder it is in. */
#include <lasertrace.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int failures = 0;

/* A row: the status expected, and words that the message holds. */
static void row(const char *what, lasertrace_status found, lasertrace_status expected,
                const char *words)
{
    const char *message = lasertrace_last_error();
    const int right = found == expected
        && (expected == LASERTRACE_STATUS_OK || strstr(message, words) != NULL);
    if (!right) {
        fprintf(stderr, "%s: status %d, \"%s\"; expected %d, \"%s\"\n", what, (int)found,
                message, (int)expected, words);
        failures++;
    }
    printf("| %s | %d | %s |\n", what, (int)found,
           found == LASERTRACE_STATUS_OK ? "" : message);
}

static void *elsewhere(void *caster)
{
    /* Another thread has its own message, and uses and frees the same handle. */
    if (strcmp(lasertrace_last_error(), "") != 0)
        return "the message of another thread";
    const lasertrace_ray ray = { { 0.2, 0.2, 1 }, { 0, 0, -1 }, 9 };
    lasertrace_surface_point hit;
    for (int i = 0; i < 1000; i++)
        if (lasertrace_closest_hits(caster, &ray, 1, &hit, 1) != LASERTRACE_STATUS_OK
            || hit.distance != 1)
            return "a wrong hit";
    return NULL;
}

static void *race(void *caster)
{
    /* Until the handle is freed by the other thread: a hit, or an error, and no crash. */
    const lasertrace_ray ray = { { 0.2, 0.2, 1 }, { 0, 0, -1 }, 9 };
    lasertrace_surface_point hit;
    lasertrace_status status;
    do
        status = lasertrace_closest_hits(caster, &ray, 1, &hit, 1);
    while (status == LASERTRACE_STATUS_OK && hit.distance == 1);
    return status == LASERTRACE_STATUS_HANDLE ? NULL : "no error of a freed handle";
}

static const double vertices[] = { 0, 0, 0, 1, 0, 0, 0, 1, 0 };
static const uint32_t triangle[] = { 0, 1, 2 };

static void casters(void)
{
    const lasertrace_status argument = LASERTRACE_STATUS_ARGUMENT;
    lasertrace_caster *none = NULL;
    const double with_nan[] = { 0, 0, 0, 1, NAN, 0, 0, 1, 0 };
    const double far_off[] = { 0, 0, 0, 1, 0, 0, 0, 1e300, 0 };
    const float narrow[] = { 0, 0, 0, 1, 0, 0, 0, INFINITY, 0 };
    const uint32_t beyond[] = { 0, 1, 2, 0, 1, 3 };
    const double scaled[] = { 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0 };
    const double moved[] = { 1, 0, 0, NAN, 0, 1, 0, 0, 0, 0, 1, 0 };
    lasertrace_caster_options options = { 0, 1, scaled, 1 };

    row("caster: vertices NULL", lasertrace_caster_new(NULL, 3, triangle, 1, NULL, &none), argument, "vertices: found NULL");
    row("caster: triangles NULL", lasertrace_caster_new(vertices, 3, NULL, 1, NULL, &none), argument, "triangles: found NULL");
    row("caster: out NULL", lasertrace_caster_new(vertices, 3, triangle, 1, NULL, NULL), argument, "out: found NULL");
    row("caster: vertices at an odd address", lasertrace_caster_new((const double *)((const char *)vertices + 1), 2, triangle, 1, NULL, &none), argument, "multiple of 8");
    row("caster: more vertices than memory", lasertrace_caster_new(vertices, SIZE_MAX, triangle, 1, NULL, &none), argument, "beyond all memory");
    row("caster: no triangle", lasertrace_caster_new(vertices, 3, triangle, 0, NULL, &none), argument, "0 triangles");
    row("caster: a vertex is NaN", lasertrace_caster_new(with_nan, 3, triangle, 1, NULL, &none), argument, "vertex 1");
    row("caster: a vertex at 1e300 mm", lasertrace_caster_new(far_off, 3, triangle, 1, NULL, &none), argument, "vertex 2");
    row("caster: an infinite 32-bit vertex", lasertrace_caster_new_f32(narrow, 3, triangle, 1, NULL, &none), argument, "vertex 2");
    row("caster: an index without a vertex", lasertrace_caster_new(vertices, 3, beyond, 2, NULL, &none), argument, "triangle 1 uses vertex 3");
    row("caster: an instance that is scaled", lasertrace_caster_new(vertices, 3, triangle, 1, &options, &none), argument, "instance 0");
    options.instances = moved;
    row("caster: an instance moved by NaN", lasertrace_caster_new(vertices, 3, triangle, 1, &options, &none), argument, "instance 0");
    options.instances = NULL;
    row("caster: instances NULL, but one of them", lasertrace_caster_new(vertices, 3, triangle, 1, &options, &none), argument, "instances: found NULL");
    options.instance_count = 0;
    options.backend = 7;
    row("caster: a backend there is not", lasertrace_caster_new(vertices, 3, triangle, 1, &options, &none), argument, "backend: found 7");
    options.backend = 0;
    options.threads = 4000000000u;
    row("caster: 4e9 threads", lasertrace_caster_new(vertices, 3, triangle, 1, &options, &none), argument, "threads: found 4000000000");
    if (none != NULL)
        failures++;
}

static void rays(void)
{
    const lasertrace_status argument = LASERTRACE_STATUS_ARGUMENT;
    lasertrace_caster *caster = NULL;
    lasertrace_ray good = { { 0.2, 0.2, 1 }, { 0, 0, -1 }, INFINITY }, ray = good;
    lasertrace_surface_point hit, pair[2];
    uint8_t any;
    double point[] = { 0, 0, NAN };
    if (lasertrace_caster_new(vertices, 3, triangle, 1, NULL, &caster))
        exit(1);

    row("rays NULL", lasertrace_closest_hits(caster, NULL, 1, &hit, 1), argument, "rays: found NULL");
    row("hits NULL", lasertrace_closest_hits(caster, &ray, 1, NULL, 1), argument, "hits: found NULL");
    row("hits shorter than rays", lasertrace_closest_hits(caster, &ray, 2, &hit, 1), argument, "number of hits: found 1, expected 2");
    row("hits in the place of rays", lasertrace_closest_hits(caster, (const lasertrace_ray *)(void *)pair, 2, pair, 2), argument, "overlap");
    row("no rays, all NULL", lasertrace_closest_hits(caster, NULL, 0, NULL, 0), LASERTRACE_STATUS_OK, "");
    ray.origin[1] = NAN;
    hit.triangle = 0;
    row("a ray from NaN", lasertrace_closest_hits(caster, &ray, 1, &hit, 1), argument, "ray 0: origin");
    if (hit.triangle != LASERTRACE_MISS)
        failures++;
    ray = good, ray.direction[2] = 0;
    row("a direction of length 0", lasertrace_closest_hits(caster, &ray, 1, &hit, 1), argument, "ray 0: direction");
    ray.direction[2] = INFINITY;
    row("an infinite direction", lasertrace_any_hits(caster, &ray, 1, &any, 1), argument, "ray 0: direction");
    ray = good, ray.t_max = NAN;
    row("t_max NaN", lasertrace_any_hits(caster, &ray, 1, &any, 1), argument, "ray 0: t_max");
    ray.t_max = -1;
    row("t_max below 0", lasertrace_closest_hits(caster, &ray, 1, &hit, 1), argument, "ray 0: t_max");
    row("any hits: NULL", lasertrace_any_hits(caster, &good, 1, NULL, 1), argument, "hit: found NULL");
    row("nearest: a point at NaN", lasertrace_nearest_points(caster, point, 1, &hit, 1), argument, "point 0");
    row("nearest: points NULL", lasertrace_nearest_points(caster, NULL, 1, &hit, 1), argument, "points: found NULL");
    row("nearest: a buffer too short", lasertrace_nearest_points(caster, point, 1, &hit, 0), argument, "number of nearest: found 0, expected 1");

    size_t starts[2];
    uint64_t count;
    uint8_t entering;
    double number;
    row("all hits: starts too short", lasertrace_all_hits(caster, &good, 1, SIZE_MAX, starts, 1, &hit, &entering, 1), argument, "number of starts: found 1, expected 2");
    row("all hits: starts NULL", lasertrace_all_hits(caster, &good, 1, SIZE_MAX, NULL, 2, &hit, &entering, 1), argument, "starts: found NULL");
    row("all hits: entering NULL", lasertrace_all_hits(caster, &good, 1, SIZE_MAX, starts, 2, &hit, NULL, 1), argument, "entering: found NULL");
    row("all hits: no room for hits", lasertrace_all_hits(caster, &good, 1, SIZE_MAX, starts, 2, NULL, NULL, 0), argument, "found room for 0, expected room for 1");
    if (starts[0] != 0 || starts[1] != 1)
        failures++;
    row("all hits: limit 0", lasertrace_all_hits(caster, &good, 1, 0, starts, 2, NULL, NULL, 0), LASERTRACE_STATUS_OK, "");
    row("all hits: one", lasertrace_all_hits(caster, &good, 1, SIZE_MAX, starts, 2, &hit, &entering, 1), LASERTRACE_STATUS_OK, "");
    if (hit.distance != 1 || entering != 1 || lasertrace_count_hits(caster, &good, 1, &count, 1) || count != 1)
        failures++;
    row("all hits: SIZE_MAX rays", lasertrace_all_hits(caster, &good, SIZE_MAX, 1, starts, SIZE_MAX, &hit, &entering, 1), argument, "overlap");
    row("all hits: hits in the place of rays", lasertrace_all_hits(caster, (const lasertrace_ray *)(void *)pair, 2, 9, starts, 3, pair, &entering, 2), argument, "overlap");
    ray = good, ray.origin[0] = INFINITY;
    row("all hits: a ray from infinity", lasertrace_all_hits(caster, &ray, 1, SIZE_MAX, starts, 2, &hit, &entering, 1), argument, "ray 0: origin");
    row("count: a ray from infinity", lasertrace_count_hits(caster, &ray, 1, &count, 1), argument, "ray 0: origin");
    row("count: counts NULL", lasertrace_count_hits(caster, &good, 1, NULL, 1), argument, "counts: found NULL");
    row("inside of an open mesh", lasertrace_contains_points(caster, vertices, 1, &any, 1), argument, "the mesh is open: found 3 edges");
    row("signed distance to an open mesh", lasertrace_signed_distances(caster, vertices, 1, &number, 1), argument, "the mesh is open");
    row("thickness of an open mesh", lasertrace_thicknesses(caster, &good, 1, &number, 1), argument, "the mesh is open");
    row("winding number around NaN", lasertrace_winding_numbers(caster, point, 1, &number, 1), argument, "point 0");
    row("winding numbers NULL", lasertrace_winding_numbers(caster, vertices, 1, NULL, 1), argument, "numbers: found NULL");

    /* Handles. */
    const lasertrace_status handle = LASERTRACE_STATUS_HANDLE;
    lasertrace_size size;
    int mine = 0;
    row("handle NULL", lasertrace_closest_hits(NULL, &good, 1, &hit, 1), handle, "found NULL");
    row("a handle made up", lasertrace_closest_hits((lasertrace_caster *)(void *)&mine, &good, 1, &hit, 1), handle, "made up");
    row("a handle of another kind", lasertrace_scene_size((lasertrace_scene *)(void *)caster, &size), handle, "expected a live lasertrace_scene");
    row("to free one of another kind", lasertrace_simulation_free((lasertrace_simulation *)(void *)caster), handle, "expected a live lasertrace_simulation");
    row("to free NULL", lasertrace_caster_free(NULL), LASERTRACE_STATUS_OK, "");

    /* Another thread. */
    pthread_t thread;
    void *wrong = NULL;
    if (pthread_create(&thread, NULL, elsewhere, caster) || pthread_join(thread, &wrong))
        exit(1);
    printf("| another thread uses the handle | 0 | |\n");
    if (wrong) {
        fprintf(stderr, "another thread: %s\n", (const char *)wrong);
        failures++;
    }
    if (pthread_create(&thread, NULL, race, caster))
        exit(1);
    row("to free one that another thread uses", lasertrace_caster_free(caster), LASERTRACE_STATUS_OK, "");
    if (pthread_join(thread, &wrong) || wrong) {
        fprintf(stderr, "a race: %s\n", (const char *)wrong);
        failures++;
    }
    row("a handle after it is freed", lasertrace_closest_hits(caster, &good, 1, &hit, 1), handle, "freed");
    row("to free it again", lasertrace_caster_free(caster), handle, "freed");
}

static void scenes(const char *path, const char *folder)
{
    const lasertrace_status argument = LASERTRACE_STATUS_ARGUMENT;
    lasertrace_scene *scene = NULL;
    lasertrace_simulation *simulation = NULL;
    lasertrace_size size;

    row("scene: path NULL", lasertrace_scene_load(NULL, &scene), argument, "path: found NULL");
    row("scene: out NULL", lasertrace_scene_load(path, NULL), argument, "out: found NULL");
    row("scene: no such file", lasertrace_scene_load("no such file", &scene), LASERTRACE_STATUS_FILE, "no such file");
    row("scene: a path that is not UTF-8", lasertrace_scene_load("\xff", &scene), argument, "UTF-8");
    row("scene: text that is none", lasertrace_scene_parse("seed = nan", folder, &scene), LASERTRACE_STATUS_INPUT, "scene text:1");
    row("scene: folder NULL", lasertrace_scene_parse("", NULL, &scene), argument, "folder: found NULL");
    if (lasertrace_scene_load(path, &scene)) {
        fprintf(stderr, "%s\n", lasertrace_last_error());
        exit(1);
    }
    row("size: out NULL", lasertrace_scene_size(scene, NULL), argument, "out: found NULL");
    row("simulation: out NULL", lasertrace_simulation_new(scene, 1, NULL), argument, "out: found NULL");
    row("simulation: 1025 threads", lasertrace_simulation_new(scene, 1025, &simulation), argument, "threads: found 1025");
    if (lasertrace_simulation_new(scene, 1, &simulation) || lasertrace_scene_size(scene, &size))
        exit(1);

    uint16_t *image = malloc((size_t)size.columns * size.rows * sizeof *image);
    if (!image)
        exit(1);
    lasertrace_frames none = { 0 }, frames = none;
    row("frames NULL", lasertrace_simulation_frames(simulation, 0, 1, NULL, NULL, NULL), argument, "frames: found NULL");
    row("frames without a buffer", lasertrace_simulation_frames(simulation, 0, 1, &none, NULL, NULL), argument, "no buffer");
    frames.image_length = 1;
    row("a length without a buffer", lasertrace_simulation_frames(simulation, 0, 1, &frames, NULL, NULL), argument, "image_length: found 1, expected 0");
    frames.images = image;
    row("a buffer too short", lasertrace_simulation_frames(simulation, 0, 1, &frames, NULL, NULL), argument, "image_length: found 1");
    frames.image_length = (size_t)size.columns * size.rows;
    row("a buffer for one frame, two asked for", lasertrace_simulation_frames(simulation, 0, 2, &frames, NULL, NULL), argument, "image_length");
    frames.depths = (float *)(void *)image;
    frames.depth_length = frames.image_length;
    row("two buffers in one place", lasertrace_simulation_frames(simulation, 0, 1, &frames, NULL, NULL), argument, "overlap");
    frames.depths = NULL;
    frames.depth_length = 0;
    row("a frame the scan does not have", lasertrace_simulation_frames(simulation, size.frames, 1, &frames, NULL, NULL), argument, "of the scan's frames");
    row("4e9 frames", lasertrace_simulation_frames(simulation, 0, UINT32_MAX, &frames, NULL, NULL), argument, "of the scan's frames");
    row("no frame", lasertrace_simulation_frames(simulation, 0, 0, &frames, NULL, NULL), argument, "of the scan's frames");
    row("a scene for a simulation", lasertrace_simulation_frames((lasertrace_simulation *)(void *)scene, 0, 1, &frames, NULL, NULL), LASERTRACE_STATUS_HANDLE, "of another kind");
    row("frames of a simulation whose scene is freed", lasertrace_scene_free(scene) ? LASERTRACE_STATUS_INTERNAL : lasertrace_simulation_frames(simulation, 0, 1, &frames, NULL, NULL), LASERTRACE_STATUS_OK, "");
    row("a scene after it is freed", lasertrace_scene_size(scene, &size), LASERTRACE_STATUS_HANDLE, "freed");
    lasertrace_features *features = NULL;
    lasertrace_feature_value value;
    row("features: out NULL", lasertrace_simulation_features(simulation, NULL), argument, "out: found NULL");
    if (lasertrace_simulation_features(simulation, &features))
        exit(1);
    row("features: count NULL", lasertrace_features_count(features, NULL), argument, "out: found NULL");
    row("features: an index beyond the last", lasertrace_features_value(features, UINT64_MAX, &value), argument, "index: found 18446744073709551615");
    row("features: free", lasertrace_features_free(features), LASERTRACE_STATUS_OK, "");
    row("features after they are freed", lasertrace_features_value(features, 0, &value), LASERTRACE_STATUS_HANDLE, "freed");
    if (lasertrace_simulation_free(simulation))
        failures++;
    free(image);
}

int main(int argc, char **argv)
{
    if (argc != 3)
        return 64;
    casters();
    rays();
    scenes(argv[1], argv[2]);
    fprintf(stderr, "%d rows wrong\n", failures);
    return failures != 0;
}
