/* Rays against triangles: a pyramid, and the same one three times.
 *
 *     cc cast.c $(pkg-config --cflags --libs lasertrace) -o cast && ./cast
 */
#include <lasertrace.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Ends the program with the library's own words if a call did not do what it should. */
static void must(lasertrace_status status)
{
    if (status != LASERTRACE_STATUS_OK) {
        fprintf(stderr, "%s\n", lasertrace_last_error());
        exit(1);
    }
}

/* Ends it if a number is not the one expected. */
static void expect(const char *what, double found, double expected)
{
    if (!(fabs(found - expected) <= 1e-12 || found == expected)) {
        fprintf(stderr, "%s: found %.17g, expected %.17g\n", what, found, expected);
        exit(1);
    }
}

int main(void)
{
    /* A pyramid 2 mm high over a square of 2 mm; mm, three numbers a vertex. */
    const double vertices[] = { -1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0, 0, 0, 2 };
    const uint32_t triangles[] = { 0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4, 0, 2, 1, 0, 3, 2 };
    lasertrace_caster *caster = NULL;
    must(lasertrace_caster_new(vertices, 5, triangles, 6, NULL, &caster));

    /* Straight down at the top vertex, at a face with a direction of length 2, and beside. */
    const lasertrace_ray rays[] = {
        { .origin = { 0, 0, 5 }, .direction = { 0, 0, -1 }, .t_max = INFINITY },
        { .origin = { 0.25, 0, 5.5 }, .direction = { 0, 0, -2 }, .t_max = INFINITY },
        { .origin = { 3, 0, 5 }, .direction = { 0, 0, -1 }, .t_max = INFINITY },
    };
    lasertrace_surface_point hits[3];
    must(lasertrace_closest_hits(caster, rays, 3, hits, 3));
    for (int i = 0; i < 3; i++) {
        if (hits[i].triangle == LASERTRACE_MISS)
            printf("ray %d meets nothing\n", i);
        else
            printf("ray %d meets triangle %u after %g, at (%g, %g, %g)\n", i,
                   (unsigned)hits[i].triangle, hits[i].distance, hits[i].point[0],
                   hits[i].point[1], hits[i].point[2]);
    }
    expect("the vertex", hits[0].distance, 3);
    expect("in lengths of the direction", hits[1].distance, 2);
    expect("the face", hits[1].point[2], 1.5);
    expect("which face", hits[1].triangle, 1);
    expect("its top vertex's weight", hits[1].barycentric[1], 0.75);
    expect("nothing", hits[2].distance, INFINITY);
    expect("nothing's instance", hits[2].instance, LASERTRACE_MISS);

    uint8_t hit[3];
    must(lasertrace_any_hits(caster, rays, 3, hit, 3));
    expect("any hits", hit[0] + 10 * hit[1] + 100 * hit[2], 11);

    const double points[] = { 0, 0, 6, 0.5, 0.5, -2 };
    lasertrace_surface_point nearest[2];
    must(lasertrace_nearest_points(caster, points, 2, nearest, 2));
    printf("the pyramid is %g mm from the first point, %g mm from the second\n",
           nearest[0].distance, nearest[1].distance);
    expect("to the top", nearest[0].distance, 4);
    expect("to the base", nearest[1].distance, 2);
    must(lasertrace_caster_free(caster));

    /* Three of it, from 32-bit floats, the second 10 mm along x, the third upside down. */
    float narrow[15];
    for (int i = 0; i < 15; i++)
        narrow[i] = (float)vertices[i];
    const double instances[] = {
        1, 0, 0, 0,  0, 1, 0, 0,  0, 0, 1, 0,
        1, 0, 0, 10, 0, 1, 0, 0,  0, 0, 1, 0,
        1, 0, 0, 20, 0, -1, 0, 0, 0, 0, -1, 0,
    };
    for (uint32_t backend = LASERTRACE_BACKEND_DEFAULT; backend <= LASERTRACE_BACKEND_RUST;
         backend += LASERTRACE_BACKEND_RUST) {
        const lasertrace_caster_options options = {
            .backend = backend, .threads = 2, .instances = instances, .instance_count = 3
        };
        must(lasertrace_caster_new_f32(narrow, 5, triangles, 6, &options, &caster));

        /* 10 000 rays in one call, a third of them over each. */
        enum { COUNT = 10000 };
        lasertrace_ray *many = calloc(COUNT, sizeof *many);
        lasertrace_surface_point *found = malloc(COUNT * sizeof *found);
        if (!many || !found)
            return 1;
        /* What stands in a buffer does not stay. */
        memset(found, 0x55, COUNT * sizeof *found);
        for (int i = 0; i < COUNT; i++) {
            many[i].origin[0] = 10 * (i % 3);
            many[i].origin[2] = 5;
            many[i].direction[2] = -1;
            many[i].t_max = INFINITY;
        }
        must(lasertrace_closest_hits(caster, many, COUNT, found, COUNT));
        for (int i = 0; i < COUNT; i++) {
            expect("an instance's number", found[i].instance, i % 3);
            expect("an instance's distance", found[i].distance, i % 3 == 2 ? 5 : 3);
        }
        free(many);
        free(found);
        must(lasertrace_caster_free(caster));
    }
    printf("lasertrace %s\n", lasertrace_version());
    return 0;
}
